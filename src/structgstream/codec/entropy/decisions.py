# SPDX-License-Identifier: Apache-2.0
"""Adaptive binary decisions: their state, and their coding in C++ or, where that is not built and in tests, in Python
(docs/entropy.md, Decisions). An encoder reads the array of values, a decoder fills it; both update models and
arithmetic code in place.

Note [One state a field]
~~~~~~~~~~~~~~~~~~~~~~~~
Packets are small, so they carry no tables: probabilities are adapted by every decision and continue from packet to
packet of a group. Each field of a packet is one arithmetic code, at most two bytes longer than the information content
of its decisions.
"""

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np
from numpy.typing import NDArray

from structgstream.codec.entropy.rans import code_native, uses_native
from structgstream.kernels.native import members

HALF = 1 << 15
NEAR_SIZES = 6
LENGTH_NODES = 9
LENGTHS = 30
NUMBER_NODES = 2 + NEAR_SIZES + LENGTH_NODES
LARGEST_NUMBER = 2**31 - 1
LARGEST_RESIDUAL = 2**23
BLOCK_CONTEXTS = (90, 198)
ACTIVITY_CONTEXTS = (255, 108, 360)
AHEAD = 3
"""Bytes that a decoder reads past the end of the data."""
_NUMBER_BYTES = 64  # upper bound of the bytes of a number or of two flags


def residual_contexts(columns: int) -> tuple[int, ...]:
    """Number of contexts of each input for residuals in ``columns`` columns."""
    return 17 * columns, 81, 31 * 5, 60 * columns, 96 * columns, 343


class NativeModel(ctypes.Structure):
    """``sgs_model``."""

    _fields_ = (*members(ctypes.c_void_p, "chances seen weights starts"), *members(ctypes.c_int32, "inputs nodes"))


@dataclass(frozen=True, eq=False)
class Model:
    """An adaptive model of decisions; each decision updates it."""

    chances: NDArray[np.uint16]  # u16 [rows, nodes], probability of 1 in units of 1/65536
    seen: NDArray[np.uint8]  # u8 [rows, nodes], number of decisions so far, up to 255
    weights: NDArray[np.int32]  # i32 [nodes, inputs], mixing weights in units of 1/65536
    starts: NDArray[np.int32]  # i32 [inputs], the row of each input's first context

    @classmethod
    def new(cls, counts: Sequence[int], *, nodes: int) -> "Model":
        """A fresh model with ``counts`` contexts of each input."""
        inputs, rows = len(counts), sum(counts)
        return cls(
            np.full((rows, nodes), HALF, np.uint16),
            np.zeros((rows, nodes), np.uint8),
            np.full((nodes, inputs), 65536 // inputs, np.int32),
            np.cumsum([0, *counts[:-1]]).astype(np.int32),
        )

    def copy(self) -> "Model":
        """An independent copy."""
        return Model(self.chances.copy(), self.seen.copy(), self.weights.copy(), self.starts)

    @cached_property
    def native(self) -> NativeModel:
        """The same memory as a C structure."""
        arrays = (self.chances, self.seen, self.weights, self.starts)
        return NativeModel(*(array.ctypes.data for array in arrays), len(self.starts), self.chances.shape[1])


class Models:
    """The models of encoder and decoder, by name."""

    def __init__(self, known: "Models | None" = None) -> None:
        self._before: dict[str, Model] = {} if known is None else known.all()
        self._now: dict[str, Model] = {}

    def get(self, name: str, counts: Sequence[int], *, nodes: int) -> Model:
        """The model of this name, which may be changed; it is copied from ``known``, whose models stay unchanged."""
        if name not in self._now:
            found = self._before.get(name)
            self._now[name] = Model.new(counts, nodes=nodes) if found is None else found.copy()
        return self._now[name]

    def all(self) -> dict[str, Model]:
        """All models, read-only."""
        return self._before | self._now


class ArithmeticState(ctypes.Structure):
    """The arithmetic code of one field, of bytes to decode, or of none to encode; also ``sgs_arithmetic``."""

    _fields_ = (
        *members(ctypes.c_void_p, "bytes"),
        *members(ctypes.c_int64, "size place"),
        *members(ctypes.c_uint32, "low range"),
        *members(ctypes.c_int32, "started"),
    )
    size: int
    place: int
    low: int
    range: int
    started: int

    def __init__(self, data: bytes | memoryview | None) -> None:
        self.encodes = data is None
        self.buffer = np.frombuffer(bytes(data or b""), np.uint8)
        super().__init__(self.buffer.ctypes.data, len(self.buffer))

    def reserve(self, numbers: int) -> None:
        """Makes room for this many more numbers."""
        need = self.place + _NUMBER_BYTES * (numbers + 1)
        if self.encodes and need > self.size:
            grown = np.empty(need, np.uint8)
            grown[: self.place] = self.buffer[: self.place]
            self.buffer, self.bytes, self.size = grown, grown.ctypes.data, need

    def is_exhausted(self) -> bool:
        """Whether a decoder has read exactly all bytes."""
        return self.place == self.size + AHEAD if self.started else not self.size

    def is_overrun(self) -> bool:
        """Whether a decoder has read further than any valid code allows."""
        return self.place > self.size + AHEAD

    def finished(self) -> bytes:
        """Finishes an encoder and returns its bytes."""
        if not self.started:
            return b""
        self.reserve(1)
        value = self.low + (1 << 24) - 1
        data = bytearray(self.buffer[: self.place].tobytes())
        if value >= 1 << 32:
            carry(data, len(data))
        return bytes(data) + bytes([value >> 24 & 255])


def carry(data: "bytearray | NDArray[np.uint8]", end: int) -> None:
    """Propagates a carry: adds 1 to the big-endian number in the bytes before ``end``."""
    while True:
        end -= 1
        data[end] = (int(data[end]) + 1) & 255
        if data[end]:
            return


LEAST, MOST = 32, 65536 - 32
FAR = 1983
SQUASHED = (
    *(32768, 36843, 40793, 44511, 47911, 50941, 53581, 55834, 57724, 59287, 60565, 61598, 62428, 63090, 63615, 64030),
    *(64357, 64614, 64816, 64974, 65097, 65194, 65269, 65328, 65374, 65410, 65438, 65459, 65476, 65489, 65500, 65508),
)
"""65536 / (1 + exp(-j / 4)), rounded."""
PASSES = ((0, 16), (8, 16), (4, 8), (2, 4), (1, 2))
"""First row and step of each pass. Coded neighbours are as far away as the first row is from 0; pass 0 has none."""
BLOCK = 32
_LIMIT = (1 << 19) - 1


def squashed(logit: int) -> int:
    """The probability, in units of 1/65536, of a logit in units of 1/256."""
    size = min(abs(logit), FAR)
    place = size >> 6
    chance = SQUASHED[place] + ((SQUASHED[place + 1] - SQUASHED[place]) * (size & 63) >> 6)
    return min(max(65536 - chance if logit < 0 else chance, LEAST), MOST)


@cache
def stretched() -> list[int]:
    """The logit, in units of 1/256, of each probability in units of 1/4096."""
    found, logit = [], -FAR
    for i in range(4096):
        while logit < FAR and squashed(logit) < 16 * i + 8:
            logit += 1
        found.append(logit)
    return found


class _Coder:
    """Codes decisions with one model; a context manager, which writes the state back on exit.

    Probabilities and weights are Python lists meanwhile, many times faster than NumPy scalars.
    """

    def __init__(self, arithmetic: ArithmeticState, model: Model) -> None:
        self._arithmetic, self._model = arithmetic, model
        self._encodes = arithmetic.encodes
        self._chances, self._seen = model.chances.ravel().tolist(), model.seen.ravel().tolist()
        self._weights: list[list[int]] = model.weights.tolist()
        self._starts = model.starts.tolist()
        self._nodes = model.chances.shape[1]
        self._data = arithmetic.buffer[: arithmetic.place if self._encodes else None].tobytes()
        self._out = bytearray(self._data)
        self._place, self._low, self._range = arithmetic.place, arithmetic.low, arithmetic.range
        if not arithmetic.started:
            self._range = (1 << 32) - 1
            if not self._encodes:
                for _ in range(4):
                    self._take()
            arithmetic.started = 1

    def __enter__(self) -> "_Coder":
        return self

    def __exit__(self, *_: object) -> None:
        model, arithmetic = self._model, self._arithmetic
        model.chances[:] = np.array(self._chances, np.uint16).reshape(model.chances.shape)
        model.seen[:] = np.array(self._seen, np.uint8).reshape(model.seen.shape)
        model.weights[:] = self._weights
        arithmetic.place, arithmetic.low, arithmetic.range = self._place, self._low, self._range
        if self._encodes:
            arithmetic.buffer[: self._place] = np.frombuffer(bytes(self._out), np.uint8)

    def _take(self) -> None:
        byte = self._data[self._place] if self._place < len(self._data) else 0
        self._low = (self._low << 8 | byte) & 0xFFFFFFFF
        self._place += 1

    def _decide(self, yes: int, chance: int) -> int:
        bound = (self._range >> 16) * chance
        if not self._encodes:
            yes = int(self._low < bound)
        if yes:
            self._range = bound
        else:
            self._low += bound if self._encodes else -bound
            self._range -= bound
            if self._low >= 1 << 32:
                carry(self._out, len(self._out))
                self._low &= 0xFFFFFFFF
        while self._range < 1 << 24:
            if self._encodes:
                self._out.append(self._low >> 24)
                self._low = self._low << 8 & 0xFFFFFFFF
                self._place += 1
            else:
                self._take()
            self._range <<= 8
        return yes

    def decide(self, yes: int, contexts: Sequence[int], node: int) -> int:
        """Codes one decision and updates the model."""
        weights, chances, seen, stretch = self._weights[node], self._chances, self._seen, stretched()
        cells = [(start + context) * self._nodes + node for start, context in zip(self._starts, contexts, strict=True)]
        logits = [stretch[chances[cell] >> 4] for cell in cells]
        chance = squashed(sum(weight * logit >> 16 for weight, logit in zip(weights, logits)))
        yes = self._decide(yes, chance)
        target = 65536 if yes else 0
        error = target - chance >> 4
        for k, cell in enumerate(cells):
            weights[k] = min(max(weights[k] + (logits[k] * error + 4096 >> 13), -_LIMIT), _LIMIT)
            step = (target - chances[cell]) * (65536 // (seen[cell] + 2)) >> 16
            chances[cell] = min(max(chances[cell] + step, LEAST), MOST)
            seen[cell] = min(seen[cell] + 1, 255)
        return yes

    def number(self, value: int, contexts: Sequence[int]) -> int:
        """Codes a signed number; a decoded one may be out of bounds."""
        if not self.decide(int(value != 0), contexts, 0):
            return 0
        negative = self.decide(int(value < 0), contexts, 1)
        given, size = abs(value), 1
        while size <= NEAR_SIZES and self.decide(int(given > size), contexts, 1 + size):
            size += 1
        if size > NEAR_SIZES:
            rest, length = given - NEAR_SIZES, 0
            while length < LENGTHS and self.decide(
                int(rest > 0 and rest >> length > 1), contexts, 2 + NEAR_SIZES + min(length, LENGTH_NODES - 1)
            ):
                length += 1
            found = 1
            for bit in range(length - 1, -1, -1):
                found = found << 1 | self._decide(rest >> bit & 1 if rest > 0 else 0, HALF)
            size = found + NEAR_SIZES
        return -size if negative else size


def _code_native(name: str, arithmetic: ArithmeticState, models: Sequence[Model], *given: int | np.ndarray) -> bool:
    """Calls a C++ coder with sizes and arrays; returns whether the coded values are within bounds."""
    state = map(ctypes.byref, (arithmetic, *(model.native for model in models)))
    return code_native(name, *state, arithmetic.encodes, *given, doing="to code decisions")


def size_class(size: int) -> int:
    """Classes 0 to 15 of sizes: one per size below 8, then two per octave."""
    if size < 8:
        return size
    top = size.bit_length() - 1
    return min(2 * top + (size >> top - 1 & 1) + 2, 15)


def code_activity(
    arithmetic: ArithmeticState,
    models: tuple[Model, Model],
    *,
    history: NDArray[np.uint8],
    sizes: NDArray[np.int32],
    active: NDArray[np.uint8],
    native: bool | None = None,
) -> None:
    """Codes which rows are active (docs/bitstream.md, section Rows).

    Args:
        models: of blocks and of rows.
        history: ``[n]``: bit 0 is the row's activity in the last frame, bits 1 and 2 in the two before.
        sizes: ``[n]``, sum of the magnitudes of each row's last residuals.
        active: ``[n]``, read or filled.
        native: C++ or Python; None takes C++ if available.
    """
    arithmetic.reserve(len(active))
    if uses_native(native):
        _code_native("sgs_code_activity", arithmetic, models, len(active), history, sizes, active)
        return
    count, pad = len(active), 24
    blocks = -(-count // BLOCK)
    past, before = history.tolist(), [past & 1 for past in history.tolist()]
    moved = [0, 0, *sizes.tolist(), 0, 0]
    last = [0] * (blocks + 2)
    ever, true = [0] * blocks, [0] * blocks
    for i, (was, now) in enumerate(zip(past, active.tolist(), strict=True)):
        last[i // BLOCK + 1] += was & 1
        ever[i // BLOCK] += was != 0
        true[i // BLOCK] |= now
    last = [min(number.bit_length(), 5) for number in last]
    there = [0] * (blocks + 8)
    with _Coder(arithmetic, models[0]) as coder:
        for level, (first, step) in enumerate(PASSES):
            for b in range(first, blocks, step):
                adjacent = there[b - first] + there[b + first] if level else 0
                wide = min(ever[b].bit_length(), 5) * 11 + last[b] + last[b + 2]
                there[b] = coder.decide(true[b], ((last[b + 1] * 3 + adjacent) * 5 + level, wide * 3 + adjacent), 0)
    found = [0] * (count + 2 * pad)
    given = active.tolist()
    with _Coder(arithmetic, models[1]) as coder:
        for level, (first, step) in enumerate(PASSES):
            for i in range(first, count, step):
                if not there[i // BLOCK]:
                    continue
                at = i + pad
                adjacent = found[at - first] + found[at + first] if level else 0
                farther = found[at - 3 * first] + found[at + 3 * first] if level else 0
                wide = sum(before[max(i - 8, 0) : i + 9]) - before[i]
                around = moved[i] + moved[i + 1] + moved[i + 3] + moved[i + 4]
                contexts = (
                    (wide * 3 + adjacent) * 5 + level,
                    (min(moved[i + 2].bit_length(), 5) * 3 + adjacent) * 6 + min(around.bit_length(), 5),
                    ((level * 3 + farther) * 3 + adjacent) * 8 + (past[i] & 7),
                )
                found[at] = coder.decide(given[i], contexts, 0)
    active[:] = found[pad : pad + count]


def code_residuals(
    arithmetic: ArithmeticState,
    model: Model,
    *,
    last: NDArray[np.int32],
    others: NDArray[np.int32],
    residuals: NDArray[np.int32],
    native: bool | None = None,
) -> bool:
    """Codes residuals of active rows (docs/bitstream.md, section Rows); returns whether they are within bounds.

    Args:
        model: of the group of columns.
        last: ``[n, c]``, the rows' last residuals.
        others: ``[n]``, sizes of the residuals in earlier groups.
        residuals: ``[n, c]``, read or filled.
    """
    arithmetic.reserve(residuals.size)
    if uses_native(native):
        return _code_native("sgs_code_residuals", arithmetic, [model], *residuals.shape, last, others, residuals)
    count, columns = residuals.shape
    past: list[list[int]] = last.tolist()
    found: list[list[int]] = residuals.tolist()
    other = [min(number.bit_length(), 5) for number in others.tolist()]
    nothing = [0] * columns
    with _Coder(arithmetic, model) as coder:
        for column in range(columns):
            for level, (first, step) in enumerate(PASSES):
                for a in range(first, count, step):
                    own = past[a][column]
                    above = found[a - first][column] if level else 0
                    below = (found[a + first] if level and a + first < count else nothing)[column]
                    contexts = _residual_contexts(past[a], found[a], own, above, below, column, level, other[a])
                    value = coder.number(found[a][column], contexts)
                    if abs(value) > LARGEST_RESIDUAL:
                        return False
                    found[a][column] = value
    residuals[:] = np.array(found, np.int32).reshape(count, columns)
    return True


def _residual_contexts(
    past: list[int], row: list[int], own: int, above: int, below: int, column: int, level: int, other: int
) -> tuple[int, ...]:
    columns, adjacent = len(past), abs(above) + abs(below)
    size = sum(map(abs, row[:column]))
    first = row[column - 1] if column else 0
    off = first - past[column - 1] if column else 0
    started = 8 * (above + below)
    continued = 10 * own + 3 * (above + below) if level else 16 * own
    predicted = continued if any(past) else started
    expected = size_class(abs(predicted) + 4 >> 3)
    return (
        (_limited(own, 8) + 8) * columns + column,
        (_limited(above, 4) + 4) * 9 + _limited(below, 4) + 4,
        ((-expected if predicted < 0 else expected) + 15) * 5 + level,
        (min(size, 9) * 6 + min(adjacent, 5)) * columns + column,
        (other * columns + column) * 16 + size_class(2 * abs(own) + adjacent),
        ((_limited(first, 3) + 3) * 7 + _limited(off, 3) + 3) * 7 + _limited(own, 3) + 3,
    )


def _limited(value: int, most: int) -> int:
    return max(-most, min(value, most))


def code_numbers(
    arithmetic: ArithmeticState,
    model: Model,
    *,
    contexts: NDArray[np.int32],
    values: NDArray[np.int64],
    flags: bool = False,
    native: bool | None = None,
) -> bool:
    """Codes signed 32-bit numbers, or flags; returns whether they are within bounds.

    Args:
        model: with one input per column of the contexts.
        contexts: ``[n, K]``, each below the model's number of contexts for its input.
        values: ``[n]``, read or filled.
        flags: whether the values are 0 and 1, with a model of one node.
    """
    arithmetic.reserve(len(values))
    if uses_native(native):
        return _code_native("sgs_code_numbers", arithmetic, [model], len(values), contexts, flags, values)
    given = values.tolist()
    with _Coder(arithmetic, model) as coder:
        for i, places in enumerate(contexts.tolist()):
            if flags:
                given[i] = coder.decide(given[i], places, 0)
            else:
                given[i] = coder.number(given[i], places)
                if abs(given[i]) > LARGEST_NUMBER:
                    return False
    values[:] = given
    return True
