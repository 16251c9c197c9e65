# SPDX-License-Identifier: Apache-2.0
"""The init record's fields as entropy-coded bins (docs/bitstream.md, section Coded init fields).

Note [Shifts]
~~~~~~~~~~~~~
The sensitivity of renderings to an anchor's values varies by orders of magnitude, because most anchors are occluded,
far away or nearly transparent. So each row has a shift: all its bins are multiples of 2^shift, which gives insensitive
rows a coarser effective step while a field has one step. The shift is coded before the row; a decoder shifts left.
"""

import math
from collections.abc import Iterable, Mapping, Set

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from structgstream.codec.entropy.bits import Bins, Contexts, Naturals, bit_lengths, unzigzag, zigzag
from structgstream.codec.entropy.rans import LARGEST_SYMBOL, SectionCoder, SectionDecoder, SectionEncoder
from structgstream.codec.fields.quantization import check_range, dequantize, quantize
from structgstream.errors import StreamError
from structgstream.scene.order import CELL_BITS, morton_cells, morton_keys
from structgstream.scene.state import FIELDS, STATE_TABLE, FieldName, InitCoding

MAX_ANCHORS = 2**22
MAX_WEIGHTS = 2**20
FREE_NUMBERS, NUMBERS_A_BYTE = 2**20, 64
"""Limits memory: all coded fields together may have 2^20 numbers plus 64 per byte. A symbol can cost nearly no bits, so
a few bytes could decode to gigabytes. Trained scenes have 5 to 9 numbers per byte."""
_MAX_GAUSSIANS, _MAX_OTHERS = 64, 256
"""Largest K, and largest value of every other letter of a shape."""
UNCODED_FIELDS: frozenset[FieldName] = frozenset(row.name for row in STATE_TABLE if row.init_coding == "uncoded")
"""Fields that the init record stores raw with either codec."""
SHIFTS = 8
_SIZES = 5  # context classes of the magnitudes in the two columns before: 0, 1, 2 to 3, 4 to 7, 8 and more
_HALF = 30  # bits of the lower half of a Z-order key
_WHERE = "The init record"


class _Counts:
    """Codes how many rows, columns or numbers there are, and counts down the numbers that are still allowed."""

    def __init__(self, coder: SectionCoder, left: int) -> None:
        self._coder, self._left = coder, left

    def code(self, name: str, count: int | None, *, most: int, what: str, numbers: int = 1) -> int:
        """Codes a count, of things of so many ``numbers`` each."""
        count = self._coder.number(name, count)
        if count > most:
            raise StreamError(f"{_WHERE} has {count} {what}; at most {most} are allowed.")
        self._left -= count * numbers
        if self._left < 0:
            raise StreamError(f"{_WHERE} has more than {NUMBERS_A_BYTE} numbers per byte; it is damaged.")
        return count


def _max_numbers(coded: Iterable[bytes | memoryview]) -> int:
    return FREE_NUMBERS + NUMBERS_A_BYTE * sum(map(len, coded))


def encode_fields(fields: Mapping[FieldName, Tensor], steps: Mapping[FieldName, float]) -> dict[FieldName, bytes]:
    """The bytes of every field that has a coding. Raises StreamError if a field has no step, a value is not a multiple
    of its step, or there are too many numbers, in absolute terms or for their bytes."""
    bins: dict[FieldName, Bins] = {}
    for name in _coded_names(fields.keys()):
        if name not in steps:
            raise StreamError(f"The header states no step for {name} in the init record.")
        found = quantize(fields[name], steps[name])
        if dequantize(found, steps[name]).numpy().tobytes() != fields[name].cpu().contiguous().numpy().tobytes():
            raise StreamError(f"The header's {name} are no multiples of the step {steps[name]:g}; quantize them first.")
        bins[name] = found
    encoder = SectionEncoder()
    numbers = sum(found.size for found in bins.values())
    _code_fields(encoder, bins, bins.keys(), allowed=numbers)
    if numbers > (most := _max_numbers(encoder.fields.values())):
        raise StreamError(
            f"The header has {numbers} numbers, more than the {most} that its bytes allow; take smaller steps."
        )
    return {name: encoder.fields[name] for name in bins}


def decode_fields(
    coded: Mapping[FieldName, bytes | memoryview], steps: Mapping[FieldName, float]
) -> dict[FieldName, Tensor]:
    """The fields that :func:`encode_fields` wrote. Raises StreamError if the bytes are damaged, or there is no step or
    no coding for a field."""
    names = _coded_names(coded.keys())
    if len(names) < len(coded):
        raise StreamError(f"{_WHERE} holds {', '.join(sorted(coded.keys() & UNCODED_FIELDS))} coded; expected raw.")
    if missing := [name for name in names if name not in steps]:
        raise StreamError(f"The header states no step for {', '.join(missing)} in the init record.")
    decoder = SectionDecoder(coded, where=_WHERE)
    bins = _code_fields(decoder, None, coded.keys(), allowed=_max_numbers(coded.values()))
    decoder.end()
    return {name: dequantize(found, steps[name]) for name, found in bins.items()}


def _coded_names(names: Set[FieldName]) -> list[FieldName]:
    return [row.name for row in STATE_TABLE if row.name in names and row.name not in UNCODED_FIELDS]


def _of_coding(coding: InitCoding, names: Set[FieldName]) -> list[FieldName]:
    return [row.name for row in STATE_TABLE if row.init_coding == coding and row.name in names]


def max_columns(name: FieldName) -> int:
    """Largest number of columns of a field that is coded as rows."""
    most = {"K": _MAX_GAUSSIANS}
    sizes = (size if isinstance(size, int) else most.get(size, _MAX_OTHERS) for size in FIELDS[name].shape[1:])
    return math.prod(sizes)


def _code_fields(
    coder: SectionCoder, bins: Mapping[FieldName, Bins] | None, names: Set[FieldName], *, allowed: int
) -> dict[FieldName, Bins]:
    """Codes the fields ``names``, of at most ``allowed`` numbers: anchor fields, then the others."""
    given, counts = bins or {}, _Counts(coder, allowed)
    positions = _code_positions(coder, given.get("anchor_positions"), counts)
    found: dict[FieldName, Bins] = {"anchor_positions": positions}
    shifts = np.zeros(len(positions), np.int32)
    for name in _of_coding("rows", names):
        rows = None
        if name in given:
            rows = given[name].reshape(len(positions), math.prod(given[name].shape[1:]))
        found[name], shifts = _code_rows(coder, name, rows, shifts, counts=counts)
    for name in _of_coding("numbers", names):
        found[name] = _code_numbers(coder, name, given[name].ravel() if name in given else None, counts)
    return _shaped(found)


def _shaped(found: dict[FieldName, Bins]) -> dict[FieldName, Bins]:
    """Reshapes bins to the shapes of the state table; the first field with a letter determines its size."""
    first_fields: dict[str | int, FieldName] = {size: row.name for row in reversed(STATE_TABLE) for size in row.shape}
    sizes: dict[str | int, int] = {}
    for name in _coded_names(found.keys()):
        bins, wanted = found[name], FIELDS[name].shape
        # Coded rows keep their number even without columns; of other fields only the total count is known.
        rows, count = ((len(bins),), math.prod(bins.shape[1:])) if bins.ndim > 1 else ((), bins.size)
        rest: list[int | None] = []
        for size in wanted[len(rows) :]:
            if isinstance(size, str) and size not in sizes and first_fields[size] != name:
                raise StreamError(f"{_WHERE} holds {name} without {first_fields[size]}, which determines its shape.")
            rest.append(size if isinstance(size, int) else sizes.get(size))
        left = count // max(1, math.prod(size for size in rest if size is not None))
        columns = tuple(left if size is None else size for size in rest)
        if count != math.prod(columns):
            raise StreamError(f"{_WHERE} holds {bins.size} numbers of {name}, which do not fit {(*rows, *columns)}.")
        sizes.update(zip(wanted, (*rows, *columns), strict=True))
        found[name] = bins.reshape((*rows, *columns))
    return found


def _code_positions(coder: SectionCoder, bins: Bins | None, counts: _Counts) -> Bins:
    """Codes cells by the differences of successive Z-order keys.

    Rows need not be in Z-order; if they are not, signs are coded too.
    """
    given = None if bins is None else len(bins)
    count = counts.code("anchor_positions.rows", given, most=MAX_ANCHORS, what="anchors", numbers=3)
    if not count:
        return np.zeros((0, 3), np.int32)
    lowest = [None] * 3 if bins is None else bins.min(0).tolist()
    origin = np.array([_code_signed(coder, "anchor_positions.origin", value) for value in lowest])
    steps: Naturals | None = None
    if bins is not None:
        cells = bins.astype(np.int64) - origin
        if int(cells.max()) >= 1 << CELL_BITS:
            raise StreamError(f"Anchors are {int(cells.max())} steps apart, at most 2^{CELL_BITS}; take a larger step.")
        steps = np.diff(morton_keys(torch.from_numpy(cells)).numpy(), prepend=0)
    descends = coder.number("anchor_positions.descends", None if steps is None else int((steps < 0).any()))
    if steps is not None and descends:
        steps = zigzag(steps)
    far = coder.naturals(
        "anchor_positions.far", None if steps is None else steps >> _HALF, np.zeros(count, np.uint16), count=1
    )
    near = coder.naturals(
        "anchor_positions.near",
        None if steps is None else steps & (1 << _HALF) - 1,
        (far > 0).astype(np.uint16),
        count=2,
    )
    if int(near.max()) >= 1 << _HALF:
        raise StreamError(f"{_WHERE} holds a position beyond {3 * CELL_BITS} bits; it is damaged.")
    steps = (far << _HALF) + near
    if descends:
        steps = unzigzag(steps)
    # The sums of both halves stay below 2^53 even in damaged data.
    low = np.cumsum(steps & (1 << _HALF) - 1)
    high = np.cumsum(steps >> _HALF) + (low >> _HALF)
    if not 0 <= int(high.min()) <= int(high.max()) < 1 << 3 * CELL_BITS - _HALF:
        raise StreamError(f"{_WHERE} holds a position beyond {3 * CELL_BITS} bits; it is damaged.")
    keys = (high << _HALF) + (low & (1 << _HALF) - 1)
    return _checked(morton_cells(torch.from_numpy(keys)).numpy() + origin)


def _code_rows(
    coder: SectionCoder, name: FieldName, bins: Bins | None, like: NDArray[np.int32], *, counts: _Counts
) -> tuple[Bins, NDArray[np.int32]]:
    """Codes rows ``[n, C]``, column by column, and their shifts, in the context of another field's shifts ``like``."""
    given = None if bins is None else bins.shape[1]
    most, what = max_columns(name), f"columns of {name}"
    columns = counts.code(f"{name}.columns", given, most=most, what=what, numbers=len(like))
    shifts = None if bins is None else _common_shifts(bins, like)
    shifts = coder.residuals(f"{name}.shift", shifts, like.astype(np.uint16), count=SHIFTS)
    if (shifts < 0).any():
        raise StreamError(f"{_WHERE} holds a shift of {name} below 0; it is damaged.")
    found = np.zeros((len(like), columns), np.int32)
    last = before = np.zeros(len(like), np.int64)
    for column in range(columns):
        middle = None if bins is None or not len(bins) else int(np.median(bins[:, column]))
        middle = _code_signed(coder, f"{name}.middle", 0 if bins is not None and middle is None else middle)
        middles = middle + (1 << shifts >> 1) >> shifts
        values = None if bins is None else (bins[:, column] >> shifts) - middles
        contexts = shifts * _SIZES + np.minimum(bit_lengths(last + before), _SIZES - 1)
        values = _code_values(coder, name, values, contexts.astype(np.uint16))
        last, before = np.abs(values), last
        found[:, column] = _checked(values + middles << shifts)
    return found, shifts


def _code_values(coder: SectionCoder, name: FieldName, values: Naturals | None, contexts: Contexts) -> Naturals:
    """Codes signed numbers ``[n]``: magnitudes up to 6 as symbols, larger ones as symbol 7 and the excess over 7."""
    clipped = None if values is None else np.clip(values, -LARGEST_SYMBOL, LARGEST_SYMBOL).astype(np.int32)
    found = coder.residuals(f"{name}.value", clipped, contexts, count=SHIFTS * _SIZES).astype(np.int64)
    large = np.flatnonzero(np.abs(found) == LARGEST_SYMBOL)
    more = None if values is None else np.abs(values[large]).astype(np.int64) - LARGEST_SYMBOL
    more = coder.naturals(f"{name}.more", more, np.zeros(len(large), np.uint16), count=1)
    found[large] += np.sign(found[large]) * more
    return found


def _common_shifts(bins: Bins, like: NDArray[np.int32]) -> NDArray[np.int32]:
    """Largest shift of each row, up to 7, such that 2^shift divides its bins; rows of zeros take that of ``like``."""
    together = np.bitwise_or.reduce(bins, axis=1) if bins.shape[1] else np.zeros(len(bins), np.int32)
    lowest = together & -together
    shifts = np.minimum(bit_lengths(lowest.astype(np.int64)) - 1, SHIFTS - 1)
    return np.where(together == 0, like, shifts).astype(np.int32)


def _code_numbers(coder: SectionCoder, name: FieldName, bins: Bins | None, counts: _Counts) -> Bins:
    """Codes numbers ``[n]`` of any size."""
    given = None if bins is None else len(bins)
    count = counts.code(f"{name}.count", given, most=MAX_WEIGHTS, what=f"numbers of {name}")
    values = None if bins is None else zigzag(bins.astype(np.int64))
    values = coder.naturals(f"{name}.value", values, np.zeros(count, np.uint16), count=1)
    return _checked(unzigzag(values))


def _code_signed(coder: SectionCoder, name: str, value: int | None) -> int:
    found = coder.number(name, None if value is None else zigzag(int(value)))
    return int(_checked(np.array([unzigzag(found)]))[0])


def _checked(bins: Naturals) -> Bins:
    check_range(bins, _WHERE)
    return bins.astype(np.int32)
