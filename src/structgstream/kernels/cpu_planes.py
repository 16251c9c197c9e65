# SPDX-License-Identifier: Apache-2.0
"""Correlation through planes in this package's C++; the contract is ``kernels.operations.PlaneScores``."""

import ctypes
from collections.abc import Sequence

import torch
from torch import Tensor

from structgstream.errors import OutOfMemoryError
from structgstream.kernels._load import native_library
from structgstream.kernels.prototypes import addresses


class _Neighbour(ctypes.Structure):
    """``sgs_neighbour`` of csrc/include/structgstream.h."""

    _fields_ = (("picture", ctypes.c_void_p), ("width", ctypes.c_int), ("height", ctypes.c_int))


def plane_scores(
    picture: Tensor, neighbours: Sequence[Tensor], homographies: Tensor, *, window: int, noise: float
) -> Tensor:
    """See ``kernels.operations.PlaneScores``; float32, in one thread.

    Raises:
        OutOfMemoryError: there is no memory for sums over windows.
    """
    planes, count = homographies.shape[:2]
    assert count == len(neighbours) > 0, (count, len(neighbours))
    assert window % 2 == 1, window
    held = [neighbour.float().contiguous() for neighbour in neighbours]
    given = (_Neighbour * count)(*((other.data_ptr(), other.shape[1], other.shape[0]) for other in held))
    picture, homographies = picture.float().contiguous(), homographies.double().contiguous()
    height, width = picture.shape
    scores = torch.empty(planes, height, width)
    failed = native_library().sgs_plane_scores(
        *addresses(picture),
        height,
        width,
        given,
        count,
        *addresses(homographies),
        planes,
        window,
        noise,
        *addresses(scores),
    )
    if failed:
        raise OutOfMemoryError("to sweep planes through a picture")
    return scores
