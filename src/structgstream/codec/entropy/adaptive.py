# SPDX-License-Identifier: Apache-2.0
"""Coders of packets with adaptive binary decisions (docs/entropy.md, Decisions)."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from structgstream.codec.entropy.bits import Bins, Flags, Naturals
from structgstream.codec.entropy.decisions import (
    ACTIVITY_CONTEXTS,
    BLOCK_CONTEXTS,
    LARGEST_NUMBER,
    NUMBER_NODES,
    ArithmeticState,
    Models,
    code_activity,
    code_numbers,
    code_residuals,
    residual_contexts,
)
from structgstream.errors import StreamError
from structgstream.scene.state import FieldName

Inputs = Sequence[NDArray[np.integer]]
"""Contexts ``[n]``, one array per input of a model."""


class AdaptiveCoder(ABC):
    """Encodes or decodes arrays; the name selects the model, its part before the dot the field.

    An encoder reads the values that it is given; a decoder gets None, and fills arrays.
    """

    def __init__(self, models: Models, *, where: str) -> None:
        self._models = models
        self._where = where
        self._codes: dict[str, ArithmeticState] = {}

    @abstractmethod
    def _code(self, name: str) -> ArithmeticState:
        """The arithmetic code of a name's field."""

    def activity(self, name: str, active: Flags | None, *, history: NDArray[np.uint8], sizes: Bins) -> Flags:
        """Mask ``[n]`` of the active rows, with their history and the sizes of their last residuals as contexts."""
        values = np.zeros(len(history), np.uint8) if active is None else active.astype(np.uint8)
        if len(values):
            blocks = self._models.get(f"{name}.blocks", BLOCK_CONTEXTS, nodes=1)
            rows = self._models.get(f"{name}.rows", ACTIVITY_CONTEXTS, nodes=1)
            code_activity(self._code(name), (blocks, rows), history=history, sizes=sizes, active=values)
            self._check_coded(name, True)
        return values.astype(np.bool_)

    def residuals(self, name: str, values: Bins | None, *, last: Bins, others: Bins) -> Bins:
        """Residuals ``[n, c]`` of active rows; contexts: their last residuals, and sizes ``[n]`` of earlier groups."""
        found = np.zeros_like(last, order="C") if values is None else np.array(values, np.int32, order="C")
        if found.size:
            model = self._models.get(name, residual_contexts(found.shape[1]), nodes=NUMBER_NODES)
            last = np.ascontiguousarray(last)
            self._check_coded(name, code_residuals(self._code(name), model, last=last, others=others, residuals=found))
        return found

    def flags(self, name: str, values: Flags | None, inputs: Inputs, *, counts: Sequence[int]) -> Flags:
        """Flags ``[n]``; each input has contexts below its entry of ``counts``."""
        given = None if values is None else values.astype(np.int64)
        return self._numbers(name, given, inputs, counts=counts, nodes=1).astype(np.bool_)

    def numbers(self, name: str, values: Naturals | None, inputs: Inputs, *, counts: Sequence[int]) -> Naturals:
        """Signed 32-bit numbers ``[n]``; ``inputs`` and ``counts`` as in :meth:`flags`."""
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


class AdaptiveEncoder(AdaptiveCoder):
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


class AdaptiveDecoder(AdaptiveCoder):
    """Reads what :class:`AdaptiveEncoder` wrote into the fields."""

    def __init__(self, models: Models, fields: Mapping[FieldName, bytes | memoryview], *, where: str) -> None:
        super().__init__(models, where=where)
        self._codes = {name: ArithmeticState(data) for name, data in fields.items()}

    def end(self) -> None:
        """Checks that all bytes have been read. Raises StreamError if there are more, or fewer."""
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
