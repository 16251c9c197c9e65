# SPDX-License-Identifier: Apache-2.0
"""Adaptive binary decisions in either direction, in C++ if available (docs/entropy.md, Decisions).

An encoder reads the array of values, a decoder fills it. Both update models and arithmetic code in place.
"""

import ctypes

import numpy as np
from numpy.typing import NDArray

from structgstream.codec.entropy import reference_decisions as reference
from structgstream.codec.entropy.models import ArithmeticState, Model
from structgstream.codec.entropy.rans import uses_native
from structgstream.errors import OutOfMemoryError, StreamError
from structgstream.kernels.native import native_library

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
    state, blocks, rows = arithmetic.native(), models[0].native, models[1].native
    result = native_library().sgs_code_activity(
        *map(ctypes.byref, (state, blocks, rows)),
        arithmetic.encodes,
        len(active),
        *map(_address, (history, sizes, active)),
    )
    arithmetic.take(state)
    _check(result)


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
    state, its_model = arithmetic.native(), model.native
    result = native_library().sgs_code_residuals(
        *map(ctypes.byref, (state, its_model)),
        arithmetic.encodes,
        len(residuals),
        residuals.shape[1],
        *map(_address, (last, others, residuals)),
    )
    arithmetic.take(state)
    return _check(result)


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
    state, its_model = arithmetic.native(), model.native
    result = native_library().sgs_code_numbers(
        *map(ctypes.byref, (state, its_model)),
        arithmetic.encodes,
        len(values),
        _address(contexts),
        flags,
        _address(values),
    )
    arithmetic.take(state)
    return _check(result)


def _address(array: np.ndarray) -> int:
    assert array.flags.c_contiguous
    return array.ctypes.data


def _check(result: int) -> bool:
    """Whether the coded values are within bounds.

    Raises:
        OutOfMemoryError: there is not enough memory.
        StreamError: a model has the wrong shape.
    """
    if result == _NO_MEMORY:
        raise OutOfMemoryError("to code decisions")
    if result > _DAMAGED:
        raise StreamError("Decisions to code do not fit their models.")
    return not result
