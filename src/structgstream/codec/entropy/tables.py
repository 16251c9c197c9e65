# SPDX-License-Identifier: Apache-2.0
"""Frequency tables of the entropy coder, in integers, and their decoding (docs/entropy.md, Symbols, Table sets).

Frequencies are coded as levels, floating-point numbers with ``p`` bits of mantissa: level 0 is frequency 0, level
``1 + e 2^p + r`` is ``(2^p + r) 2^e``. The precision ``p`` of a row depends on its number of symbols.
"""

from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np
from numpy.typing import NDArray

from structgstream.codec.entropy.bits import BitReader, fixed, pack_bits, signed_golomb
from structgstream.errors import StreamError

FREQUENCY_BITS = 12
TOTAL = 1 << FREQUENCY_BITS
GEOMETRIC_ROWS = 256
COST_BITS = 16


@dataclass(frozen=True, eq=False)
class FrequencyTables:
    """One row of frequencies per context."""

    rows: NDArray[np.uint16]  # u16 [C, A], each row summing to 4096; C at most 4096, A at most 32

    def __post_init__(self) -> None:
        assert self.rows.dtype == np.uint16
        assert (self.rows.sum(1, dtype=np.int64) == TOTAL).all()

    @property
    def contexts(self) -> int:
        """C, the number of contexts."""
        return self.rows.shape[0]

    @property
    def alphabet(self) -> int:
        """A, the number of symbols."""
        return self.rows.shape[1]

    @cached_property
    def starts(self) -> NDArray[np.uint16]:
        """Sums of the frequencies before each symbol, u16 ``[C, A]``."""
        return (np.cumsum(self.rows, axis=1, dtype=np.int64) - self.rows).astype(np.uint16)


def normalize_counts(counts: NDArray[np.integer]) -> FrequencyTables:
    """Frequencies that nearly minimise the code length of counted symbols; a row without counts is uniform.

    Symbols that occur get at least 1, others 0. Starting from the floors of the quotas, each missing unit is added to
    the symbol where ``count / (2 frequency + 1)`` is largest (Sainte-Lague divisors: to second order the greatest gain
    in code length), each surplus unit taken where ``count / (2 frequency - 1)`` is least; ties go to the lower symbol.

    Args:
        counts: ``[C, A]``, not negative, a row's sum below 2^40.
    """
    n = counts.astype(np.int64)
    n[n.sum(1) == 0] = 1
    rows = np.where(n > 0, np.maximum(n * TOTAL // n.sum(1, keepdims=True), 1), 0)
    while len(short := np.flatnonzero(rows.sum(1) < TOTAL)):
        rows[short, _largest(n[short], 2 * rows[short] + 1)] += 1
    while len(over := np.flatnonzero(rows.sum(1) > TOTAL)):
        f = rows[over]
        # The least n / d is the largest d / n; a frequency of 1 stays.
        rows[over, _largest(np.where(f > 1, 2 * f - 1, 0), np.maximum(n[over], 1))] -= 1
    return FrequencyTables(rows.astype(np.uint16))


def _largest(numerators: NDArray[np.int64], denominators: NDArray[np.int64]) -> NDArray[np.int64]:
    """Index of the largest fraction of each row, the first of equals; exact, by cross-multiplication."""
    best = np.zeros(len(numerators), np.int64)
    n, d = numerators[:, 0], denominators[:, 0]
    for column in range(1, numerators.shape[1]):
        wins = numerators[:, column] * d > n * denominators[:, column]
        best[wins] = column
        n, d = np.where(wins, numerators[:, column], n), np.where(wins, denominators[:, column], d)
    return best


def weighed(weights: NDArray[np.int64]) -> NDArray[np.int64]:
    """Frequencies ``[..., A]`` for integer weights: the floors of the quotas, at least 1 where the weight is positive.

    The difference to 4096 is added to the first of the largest weights. Decoders apply this to the weights of a table
    set; :func:`normalize_counts` is for counts.
    """
    rows = np.where(weights > 0, np.maximum(weights * TOTAL // weights.sum(-1, keepdims=True), 1), 0)
    peak = weights.argmax(-1)[..., None]
    rest = TOTAL - rows.sum(-1, keepdims=True)
    np.put_along_axis(rows, peak, np.take_along_axis(rows, peak, -1) + rest, -1)
    return rows


@cache
def geometric_family(alphabet: int) -> NDArray[np.uint16]:
    """All 256 two-sided geometric rows ``[256, A]`` for 2 to 32 symbols in the order 0, -1, 1, -2, 2 ..., read-only.

    Number ``g`` is ``8 z + q``: ``z`` (0 to 31) sets the odds of zero against everything else to
    ``(2 + z % 2) 2^(z // 2) / 16``, ``q`` (0 to 7) the ratio from one magnitude to the next to ``(2 q + 1) / 16``.
    """
    numbers = np.arange(GEOMETRIC_ROWS)
    z, q = numbers >> 3, numbers & 7
    weights = np.zeros((len(numbers), alphabet), np.int64)
    side = np.full(len(numbers), 1 << 16, np.int64)
    for symbol in range(1, alphabet):
        if symbol > 1 and symbol % 2:
            side = side * (2 * q + 1) >> 4
        weights[:, symbol] = np.maximum(side, 1)
    weights[:, 0] = ((2 + (z & 1)) << (z >> 1)) * weights.sum(1) >> 4
    rows = weighed(weights).astype(np.uint16)
    rows.setflags(write=False)
    return rows


@cache
def logs() -> NDArray[np.int64]:
    """log2 of 0 to 8191 in units of 2^-16, rounded down bit by bit; 0 for 0."""
    n = np.maximum(np.arange(2 * TOTAL), 1)
    whole = np.frexp(n.astype(np.float64))[1].astype(np.int64) - 1
    x = (n.astype(np.uint64) << np.uint64(31)) >> whole.astype(np.uint64)  # 1 to 2, with 31 bits after the point
    log = whole
    for _ in range(COST_BITS):
        x = x * x >> np.uint64(31)
        digit = (x >> np.uint64(32)).astype(np.int64)
        x >>= digit.astype(np.uint64)
        log = 2 * log + digit
    return log


@cache
def code_costs() -> NDArray[np.int64]:
    """Cost of a symbol of frequency 0 to 4096, in units of 2^-16 bit; for encoders' choices."""
    costs = (FREQUENCY_BITS << COST_BITS) - logs()[: TOTAL + 1]
    costs[0] = 1 << 28  # not to be coded at all
    return costs


NUMBER_BITS = 8
PRECISION_BITS = 2
COUNT_BITS = 5
MAX_ZEROS = 8
_MAX_ROW_BYTES = 72  # more than any valid row takes: its 32 levels are at most 17 bits each, but not all as long


def levels_of(frequencies: NDArray[np.integer], *, precision: int) -> NDArray[np.int64]:
    """Levels, rounded down, of frequencies 0 to 4096; 0 gives level 1, because only present symbols' are coded."""
    f = np.maximum(frequencies.astype(np.int64), 1)
    exponent = np.frexp(f.astype(np.float64))[1].astype(np.int64) - 1  # exact for integers
    return 1 + (exponent << precision) + (f << precision >> exponent) - (1 << precision)


def weights_of(levels: NDArray[np.int64], *, precision: int) -> NDArray[np.int64]:
    """The frequencies of levels, in units of ``2^-precision``; 0 for level 0."""
    place = np.maximum(levels - 1, 0)
    mantissa = (1 << precision) + (place & (1 << precision) - 1)
    return np.where(levels > 0, mantissa << (place >> precision), 0)


def top_level(precision: int) -> int:
    """The highest level: just below twice 4096."""
    return (FREQUENCY_BITS + 1) << precision


def decode_tables(
    data: bytes | memoryview, previous: FrequencyTables, *, where: str = "A table set"
) -> FrequencyTables:
    """The tables coded in ``data`` relative to the previous ones, which have the same contexts and alphabet. Raises
    StreamError if the set is damaged."""
    if len(data) > _MAX_ROW_BYTES * previous.contexts:
        raise StreamError(f"{where} has {len(data)} bytes for {previous.contexts} contexts; it is damaged.")
    if not len(data):
        return previous  # empty data: all rows stay
    reader = BitReader(data, where=where)
    family = geometric_family(previous.alphabet)
    rows = previous.rows.copy()
    for row in rows:
        if not reader.fixed(1):
            continue
        if not reader.fixed(1):
            row[:] = family[reader.fixed(NUMBER_BITS)]
            continue
        reference = family[reader.fixed(NUMBER_BITS)] if reader.fixed(1) else row
        row[:] = _explicit_row(reader, reference, where=where)
    reader.end()
    return FrequencyTables(rows)


def _explicit_row(reader: BitReader, reference: NDArray[np.uint16], *, where: str) -> NDArray[np.int64]:
    alphabet = len(reference)
    precision, order = reader.fixed(PRECISION_BITS), reader.fixed(1)
    if reader.fixed(1):
        present = [symbol for symbol in range(alphabet) if reader.fixed(1)]
    else:
        present = list(range(reader.fixed(COUNT_BITS) + 1))
    if not present or present[-1] >= alphabet:
        raise StreamError(f"{where} has a row without symbols, or with more than {alphabet}; it is damaged.")
    levels = np.zeros(alphabet, np.int64)
    levels[present] = levels_of(reference[present], precision=precision)
    for symbol in present if len(present) > 1 else ():
        levels[symbol] += reader.signed_golomb(order=order, max_zeros=MAX_ZEROS)
        if not 1 <= levels[symbol] <= top_level(precision):
            raise StreamError(f"{where} holds a frequency out of bounds; it is damaged.")
    return weighed(weights_of(levels, precision=precision))


_PER_LN2 = 94548  # 2^16 / ln 2
_EXPLICIT_BITS = 2 + 1 + PRECISION_BITS + 1 + 1


@dataclass(frozen=True)
class _Explicit:
    """Explicitly coded rows of one precision.

    The first axes are flags: whether levels are relative to the geometric row, not to the previous one; the order of
    their codes; whether presence is coded as one flag per symbol (a bitmap), not as a number of symbols.
    """

    rows: NDArray[np.int64]  # [2, 2, 2, C, A] frequencies
    cost: NDArray[np.int64]  # [2, 2, 2, C] of row and symbols, 2^-16 bit
    steps: NDArray[np.int64]  # [2, 2, C, A], levels relative to those of the reference, by reference and order
    present: NDArray[np.bool_]  # [2, C, A], by coding of presence

    def bits(self, form: tuple[int, int, int], context: int, *, precision: int, number: int) -> str:
        """The row of one context as bits; ``form`` are the flags, ``number`` is that of its geometric row."""
        geometric, order, bitmap = form
        flags = self.present[bitmap, context]
        present = np.flatnonzero(flags)
        text = "111" + fixed(number, NUMBER_BITS) if geometric else "110"
        text += fixed(precision, PRECISION_BITS) + fixed(order, 1) + fixed(bitmap, 1)
        text += "".join(fixed(bool(there), 1) for there in flags) if bitmap else fixed(len(present) - 1, COUNT_BITS)
        steps = self.steps[geometric, order, context, present].tolist() if len(present) > 1 else []
        return text + "".join(signed_golomb(step, order=order) for step in steps)


def choose_tables(counts: NDArray[np.integer], previous: FrequencyTables) -> tuple[FrequencyTables, bytes]:
    """Tables for counted symbols, and their coding relative to the previous ones.

    Args:
        counts: ``[C, A]``, number of occurrences of each symbol in each context, 2^31 - 1 in all at most.
        previous: the decoder's tables; a row stays where a new one would cost more bits than it saves.
    """
    counts = counts.astype(np.int64)
    kept = previous.rows.astype(np.int64)
    family = geometric_family(previous.alphabet).astype(np.int64)
    of_family = (counts @ code_costs()[family].T) + (2 + NUMBER_BITS << COST_BITS)
    number = of_family.argmin(1)
    keep, parametric = _data_cost(counts, kept) + (1 << COST_BITS), of_family.min(1)
    rows, cost = np.where((parametric < keep)[:, None], family[number], kept), np.minimum(keep, parametric)
    pieces = ["10" + fixed(g, NUMBER_BITS) if new else "0" for g, new in zip(number.tolist(), parametric < keep)]
    # Explicit rows are tried only where exact frequencies would save more than the head of such a row.
    least = _data_cost(counts, normalize_counts(counts).rows.astype(np.int64)) + (
        _EXPLICIT_BITS + COUNT_BITS << COST_BITS
    )
    tried = np.flatnonzero(least < cost)
    if len(tried):
        references = np.stack([kept[tried], family[number[tried]]])
        found = [_explicit(counts[tried], references, precision) for precision in range(1 << PRECISION_BITS)]
        costs = np.stack([one.cost for one in found], axis=1)  # Of equally cheap forms the first is taken.
        best = costs.reshape(-1, len(tried)).argmin(0)
        for place, flags in enumerate(zip(*np.unravel_index(best, costs.shape[:4]))):
            context, (geometric, precision, order, bitmap) = tried[place], map(int, flags)
            if costs[*flags, place] < cost[context]:
                form = geometric, order, bitmap
                rows[context] = found[precision].rows[*form, place]
                pieces[context] = found[precision].bits(form, place, precision=precision, number=int(number[context]))
    changes = any(piece != "0" for piece in pieces)
    return FrequencyTables(rows.astype(np.uint16)), pack_bits(pieces) if changes else b""


def _explicit(counts: NDArray[np.int64], reference_rows: NDArray[np.int64], precision: int) -> _Explicit:
    """Explicit rows of one precision in every form.

    With a fixed scale of the weights (the reference's), the best level of each symbol is independent of the others: it
    balances ``count log2(weight)``, the share that the weight takes from all others, and the bits of the level.

    Args:
        counts: ``[C, A]``.
        reference_rows: ``[2, C, A]``, the previous rows and the geometric ones.
        precision: of levels.
    """
    alphabet = counts.shape[1]
    references = levels_of(reference_rows, precision=precision)
    every = weights_of(np.arange(1, top_level(precision) + 1), precision=precision)
    shares = counts.sum(1)[:, None, None] * every * _PER_LN2 >> 12 + precision
    level_costs = shares - counts[..., None] * logs()[every >> precision]
    step_bits = np.stack([_step_bits(precision, order) for order in (0, 1)])[:, references - 1].swapaxes(0, 1)
    levels = 1 + (level_costs + (step_bits << COST_BITS)).argmin(-1)
    bits = np.take_along_axis(step_bits, levels[..., None] - 1, -1)[..., 0]
    occurs = counts > 0
    last = alphabet - 1 - occurs[:, ::-1].argmax(1)
    present = np.stack([np.arange(alphabet) <= last[:, None], occurs])
    rows = weighed(np.where(present, weights_of(levels, precision=precision)[:, :, None], 0))
    of_presence, of_reference = np.array([COUNT_BITS, alphabet]), np.array([0, NUMBER_BITS])
    heads = _EXPLICIT_BITS + of_presence[:, None] + of_reference[:, None, None, None]
    size = heads + np.where(present.sum(-1) > 1, (bits[:, :, None] * present).sum(-1), 0)
    return _Explicit(rows, _data_cost(counts, rows) + (size << COST_BITS), levels - references[:, None], present)


def _data_cost(counts: NDArray[np.int64], rows: NDArray[np.int64]) -> NDArray[np.int64]:
    return (counts * code_costs()[rows]).sum(-1)


@cache
def _step_bits(precision: int, order: int) -> NDArray[np.int64]:
    """Bits from each level (from 1 on) to each other."""
    top = top_level(precision)
    sizes = np.array([len(signed_golomb(step, order=order)) for step in range(1 - top, top)], np.int64)
    return sizes[np.arange(top)[None, :] - np.arange(top)[:, None] + top - 1]
