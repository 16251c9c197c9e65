# SPDX-License-Identifier: Apache-2.0
"""State of adaptive decisions: probabilities, mixing weights, arithmetic codes (docs/entropy.md, Decisions).

Note [One state a field]
~~~~~~~~~~~~~~~~~~~~~~~~
Packets are small, so they carry no tables: probabilities are adapted by every decision and continue from packet to
packet of a group. Each field of a packet is one arithmetic code, at most two bytes longer than the information content
of its decisions.
"""

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

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

    _fields_ = (
        ("chances", ctypes.c_void_p),
        ("seen", ctypes.c_void_p),
        ("weights", ctypes.c_void_p),
        ("starts", ctypes.c_void_p),
        ("inputs", ctypes.c_int32),
        ("nodes", ctypes.c_int32),
    )


class NativeArithmetic(ctypes.Structure):
    """``sgs_arithmetic``."""

    _fields_ = (
        ("bytes", ctypes.c_void_p),
        ("size", ctypes.c_int64),
        ("place", ctypes.c_int64),
        ("low", ctypes.c_uint32),
        ("range", ctypes.c_uint32),
        ("started", ctypes.c_int32),
    )


@dataclass(frozen=True, eq=False)
class Model:
    """An adaptive model of decisions; each decision updates it.

    Args:
        chances: u16 ``[rows, nodes]``, probability of 1 in units of 1/65536.
        seen: u8 ``[rows, nodes]``, number of decisions so far, up to 255.
        weights: i32 ``[nodes, inputs]``, mixing weights in units of 1/65536.
        starts: i32 ``[inputs]``, the row of each input's first context.
    """

    chances: NDArray[np.uint16]
    seen: NDArray[np.uint8]
    weights: NDArray[np.int32]
    starts: NDArray[np.int32]

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

    @property
    def nodes(self) -> int:
        """Number of binary decisions (nodes) of a value."""
        return self.chances.shape[1]

    @cached_property
    def native(self) -> NativeModel:
        """The same memory as a C structure."""
        arrays = (self.chances, self.seen, self.weights, self.starts)
        return NativeModel(*(array.ctypes.data for array in arrays), len(self.starts), self.nodes)


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


class ArithmeticState:
    """The arithmetic code of one field, in either direction.

    Args:
        data: the bytes to decode; None to encode.
    """

    def __init__(self, data: bytes | memoryview | None) -> None:
        self.encodes = data is None
        self.buffer = np.zeros(0, np.uint8) if data is None else np.frombuffer(bytes(data), np.uint8)
        self.size = len(self.buffer)
        self.place = self.low = self.range = self.started = 0

    def reserve(self, numbers: int) -> None:
        """Makes room for this many more numbers."""
        need = self.place + _NUMBER_BYTES * (numbers + 1)
        if self.encodes and need > self.size:
            grown = np.empty(need, np.uint8)
            grown[: self.place] = self.buffer[: self.place]
            self.buffer, self.size = grown, need

    def native(self) -> NativeArithmetic:
        """The state as a C structure; :meth:`take` reads it back."""
        return NativeArithmetic(self.buffer.ctypes.data, self.size, self.place, self.low, self.range, self.started)

    def take(self, state: NativeArithmetic) -> None:
        """Takes over the state after a C++ call."""
        self.place, self.low, self.range, self.started = state.place, state.low, state.range, state.started

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
