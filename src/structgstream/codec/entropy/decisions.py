# SPDX-License-Identifier: Apache-2.0
"""Adaptive decisions in either direction, in C++ where it is (docs/entropy.md, Decisions).

What is coded is an array that an encoder reads and a decoder fills. Both leave models and arithmetic code as they are
behind it.
"""

import ctypes

import numpy as np
from numpy.typing import NDArray

from structgstream.codec.entropy import reference_decisions as reference
from structgstream.codec.entropy.models import ArithmeticState, Model
from structgstream.codec.entropy.rans import uses_native
from structgstream.errors import OutOfMemoryError, StreamError
from structgstream.kernels._load import native_library

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
    """Which rows are active (docs/bitstream.md, section Rows).

    Args:
        arithmetic: of the field.
        models: of blocks and of rows.
        history: ``[n]``: bit 0 is what the last frame did, bits 1 and 2 what those before did.
        sizes: ``[n]``, of each row's last residuals together.
        active: ``[n]``.
        native: C++ or Python; None takes C++ where it is.
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
    """Residuals of active rows (docs/bitstream.md, section Rows); whether they are sound.

    Args:
        arithmetic: of the field.
        model: of the group of columns.
        last: ``[n, c]``, the rows' last residuals.
        others: ``[n]``, sizes of the residuals in the groups before.
        residuals: ``[n, c]``.
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
    """Signed numbers of 32 bits, or flags; whether they are sound.

    Args:
        arithmetic: of the field.
        model: with an input for each column of the contexts.
        contexts: ``[n, K]``, each below what the model has for its input.
        values: ``[n]``.
        flags: whether they are 0 and 1, with a model of one node.
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
    """Whether what was coded is sound.

    Raises:
        OutOfMemoryError: memory does not suffice.
        StreamError: a model does not fit.
    """
    if result == _NO_MEMORY:
        raise OutOfMemoryError("to code decisions")
    if result > _DAMAGED:
        raise StreamError("Decisions to code do not fit their models.")
    return not result
