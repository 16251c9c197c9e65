# SPDX-License-Identifier: Apache-2.0
"""Coders of packets with adaptive binary decisions, in C++ if available (docs/entropy.md, Decisions).

An encoder reads the array of values, a decoder fills it. Both update models and arithmetic code in place.
"""

import ctypes
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from structgstream.codec.entropy import decisions as reference
from structgstream.codec.entropy.bits import Bins, Flags, Naturals
from structgstream.codec.entropy.decisions import (
    ACTIVITY_CONTEXTS,
    BLOCK_CONTEXTS,
    LARGEST_NUMBER,
    NUMBER_NODES,
    ArithmeticState,
    Model,
    Models,
    residual_contexts,
)
from structgstream.codec.entropy.rans import uses_native
from structgstream.errors import OutOfMemoryError, StreamError
from structgstream.kernels.native import native_library
from structgstream.scene.state import FieldName

_NO_MEMORY, _DAMAGED = 1, 2


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
        arithmetic: of the field.
        models: of blocks and of rows.
        history: ``[n]``: bit 0 is the row's activity in the last frame, bits 1 and 2 in the two before.
        sizes: ``[n]``, sum of the magnitudes of each row's last residuals.
        active: ``[n]``, read or filled.
        native: C++ or Python; None takes C++ if available.
    """
    arithmetic.reserve(len(active))
    if not uses_native(native):
        reference.code_activity(arithmetic, models, history=history, sizes=sizes, active=active)
        return
    _code_native("sgs_code_activity", arithmetic, models, len(active), history, sizes, active)


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
        arithmetic: of the field.
        model: of the group of columns.
        last: ``[n, c]``, the rows' last residuals.
        others: ``[n]``, sizes of the residuals in earlier groups.
        residuals: ``[n, c]``, read or filled.
        native: as in :func:`code_activity`.
    """
    arithmetic.reserve(residuals.size)
    if not uses_native(native):
        return reference.code_residuals(arithmetic, model, last=last, others=others, residuals=residuals)
    return _code_native("sgs_code_residuals", arithmetic, [model], *residuals.shape, last, others, residuals)


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
        arithmetic: of the field.
        model: with one input per column of the contexts.
        contexts: ``[n, K]``, each below the model's number of contexts for its input.
        values: ``[n]``, read or filled.
        flags: whether the values are 0 and 1, with a model of one node.
        native: as in :func:`code_activity`.
    """
    arithmetic.reserve(len(values))
    if not uses_native(native):
        return reference.code_numbers(arithmetic, model, contexts=contexts, values=values, flags=flags)
    return _code_native("sgs_code_numbers", arithmetic, [model], len(values), contexts, flags, values)


def _code_native(name: str, arithmetic: ArithmeticState, models: Sequence[Model], *given: int | np.ndarray) -> bool:
    """Calls a C++ coder with sizes and arrays; returns whether the coded values are within bounds.

    Raises:
        OutOfMemoryError: there is not enough memory.
        StreamError: a model has the wrong shape.
    """
    state, arguments = arithmetic.native(), list[int]()
    for value in given:
        if isinstance(value, np.ndarray):
            assert value.flags.c_contiguous
            value = value.ctypes.data
        arguments.append(value)
    coder = getattr(native_library(), name)
    result = coder(*map(ctypes.byref, (state, *(model.native for model in models))), arithmetic.encodes, *arguments)
    arithmetic.take(state)
    if result == _NO_MEMORY:
        raise OutOfMemoryError("to code decisions")
    if result > _DAMAGED:
        raise StreamError("Decisions to code do not fit their models.")
    return not result


Inputs = Sequence[NDArray[np.integer]]
"""Contexts ``[n]``, one array per input of a model."""


class AdaptiveCoder(Protocol):
    """Encodes or decodes arrays; the name selects the model, its part before the dot the field."""

    def activity(self, name: str, active: Flags | None, *, history: NDArray[np.uint8], sizes: Bins) -> Flags:
        """Mask ``[n]`` of the active rows, with their history and the sizes of their last residuals as contexts."""
        ...

    def residuals(self, name: str, values: Bins | None, *, last: Bins, others: Bins) -> Bins:
        """Residuals ``[n, c]`` of active rows; contexts: their last residuals, and sizes ``[n]`` of earlier groups."""
        ...

    def flags(self, name: str, values: Flags | None, inputs: Inputs, *, counts: Sequence[int]) -> Flags:
        """Flags ``[n]``; each input has contexts below its entry of ``counts``."""
        ...

    def numbers(self, name: str, values: Naturals | None, inputs: Inputs, *, counts: Sequence[int]) -> Naturals:
        """Signed 32-bit numbers ``[n]``; ``inputs`` and ``counts`` as in :meth:`flags`."""
        ...


class _Adaptive(ABC):
    """Common part of both directions: arrays are read or filled in place."""

    def __init__(self, models: Models, *, where: str) -> None:
        self._models = models
        self._where = where
        self._codes: dict[str, ArithmeticState] = {}

    @abstractmethod
    def _code(self, name: str) -> ArithmeticState:
        """The arithmetic code of a name's field."""

    def activity(self, name: str, active: Flags | None, *, history: NDArray[np.uint8], sizes: Bins) -> Flags:
        values = np.zeros(len(history), np.uint8) if active is None else active.astype(np.uint8)
        if len(values):
            blocks = self._models.get(f"{name}.blocks", BLOCK_CONTEXTS, nodes=1)
            rows = self._models.get(f"{name}.rows", ACTIVITY_CONTEXTS, nodes=1)
            code_activity(self._code(name), (blocks, rows), history=history, sizes=sizes, active=values)
            self._check_coded(name, True)
        return values.astype(np.bool_)

    def residuals(self, name: str, values: Bins | None, *, last: Bins, others: Bins) -> Bins:
        found = np.zeros_like(last, order="C") if values is None else np.array(values, np.int32, order="C")
        if found.size:
            model = self._models.get(name, residual_contexts(found.shape[1]), nodes=NUMBER_NODES)
            last = np.ascontiguousarray(last)
            self._check_coded(name, code_residuals(self._code(name), model, last=last, others=others, residuals=found))
        return found

    def flags(self, name: str, values: Flags | None, inputs: Inputs, *, counts: Sequence[int]) -> Flags:
        given = None if values is None else values.astype(np.int64)
        return self._numbers(name, given, inputs, counts=counts, nodes=1).astype(np.bool_)

    def numbers(self, name: str, values: Naturals | None, inputs: Inputs, *, counts: Sequence[int]) -> Naturals:
        return self._numbers(name, values, inputs, counts=counts, nodes=NUMBER_NODES)

    def _numbers(
        self, name: str, values: Naturals | None, inputs: Inputs, *, counts: Sequence[int], nodes: int
    ) -> Naturals:
        contexts = np.stack(inputs, axis=1).astype(np.int32)
        found = np.zeros(len(contexts), np.int64) if values is None else values.astype(np.int64)
        if len(found):
            model = self._models.get(name, counts, nodes=nodes)
            sound = code_numbers(self._code(name), model, contexts=contexts, values=found, flags=nodes == 1)
            self._check_coded(name, sound)
        return found

    @abstractmethod
    def _check_coded(self, name: str, sound: bool) -> None:
        """Called after a name has been coded; ``sound``: whether its numbers are within bounds."""


class AdaptiveEncoder(_Adaptive):
    """Encodes; the part of a name before the dot is the field that the bytes are appended to."""

    def numbers(self, name: str, values: Naturals | None, inputs: Inputs, *, counts: Sequence[int]) -> Naturals:
        assert values is not None
        if len(values) and int(np.abs(values).max()) > LARGEST_NUMBER:
            raise StreamError("A number is beyond 31 bits; take a larger quantization step.")
        return super().numbers(name, values, inputs, counts=counts)

    def fields(self) -> dict[str, bytes]:
        """The bytes of each field; finishes the encoder."""
        return {name: code.finished() for name, code in self._codes.items()}

    def _code(self, name: str) -> ArithmeticState:
        return self._codes.setdefault(name.partition(".")[0], ArithmeticState(None))

    def _check_coded(self, name: str, sound: bool) -> None:
        if not sound:
            raise StreamError(f"{self._where} changes {name} by more than can be coded; take a larger step.")


class AdaptiveDecoder(_Adaptive):
    """Reads what :class:`AdaptiveEncoder` wrote into the fields."""

    def __init__(self, models: Models, fields: Mapping[FieldName, bytes | memoryview], *, where: str) -> None:
        super().__init__(models, where=where)
        self._codes = {name: ArithmeticState(data) for name, data in fields.items()}

    def end(self) -> None:
        """Checks that all bytes have been read.

        Raises:
            StreamError: there are more, or fewer.
        """
        for name, code in self._codes.items():
            if not code.is_exhausted():
                raise StreamError(f"{self._where} has {code.size} bytes of {name}, which are not all; it is damaged.")

    def _code(self, name: str) -> ArithmeticState:
        field = name.partition(".")[0]
        if field not in self._codes:
            raise StreamError(f"{self._where} holds no {field}, which the header announces; it is damaged.")
        return self._codes[field]

    def _check_coded(self, name: str, sound: bool) -> None:
        if not sound:
            raise StreamError(f"{self._where}, {name}, holds a number out of bounds; it is damaged.")
        if self._code(name).is_overrun():
            raise StreamError(f"{self._where} ends too early in {name.partition('.')[0]}; it is damaged.")
