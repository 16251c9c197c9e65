# SPDX-License-Identifier: Apache-2.0
"""The plane sweep along rays in this package's C++; the contract is ``kernels.operations.Sweep``."""

import ctypes
from collections.abc import Sequence

import torch
from torch import Tensor

from structgstream.kernels._load import native_library
from structgstream.kernels.motion_types import SweepView, Swept
from structgstream.kernels.prototypes import addresses


class _View(ctypes.Structure):
    _fields_ = (
        ("colors", ctypes.c_void_p),
        ("missing", ctypes.c_void_p),
        ("depths", ctypes.c_void_p),
        ("viewmat", ctypes.c_float * 12),
        ("K", ctypes.c_float * 9),
        ("near_plane", ctypes.c_float),
        ("width", ctypes.c_int),
        ("height", ctypes.c_int),
    )


def sweep(
    views: Sequence[SweepView],
    view_index: int,
    pixels: Tensor,
    farthest: Tensor,
    *,
    planes: int,
    least_supports: int,
    most_contradictions: float,
) -> Swept:
    """See ``kernels.operations.Sweep``; float32."""
    assert len(pixels) == len(farthest), (pixels.shape, farthest.shape)
    held = [[t.detach().float().contiguous() for t in (v.colors, v.missing, v.depths)] for v in views]
    given = (_View * len(views))()
    for slot, view, tensors in zip(given, views, held, strict=True):
        slot.height, slot.width = view.missing.shape
        assert view.colors.shape == (slot.height, slot.width, 3), view.colors.shape
        assert view.depths.shape == view.missing.shape, view.depths.shape
        slot.colors, slot.missing, slot.depths = addresses(*tensors)
        slot.viewmat[:] = view.viewmat[:3].reshape(-1).tolist()
        slot.K[:] = view.K.reshape(-1).tolist()
        slot.near_plane = view.near
    pixels, farthest = pixels.to(torch.int64).contiguous(), farthest.float().contiguous()
    found = Swept(torch.empty(len(pixels)), torch.empty(len(pixels)))
    native_library().sgs_sweep(
        given,
        len(views),
        view_index,
        *addresses(pixels, farthest),
        len(pixels),
        planes,
        least_supports,
        most_contradictions,
        *addresses(found.depths, found.costs),
        torch.get_num_threads(),
    )
    return found
