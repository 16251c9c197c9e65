# SPDX-License-Identifier: Apache-2.0
"""The plane sweep along rays in this package's CUDA; the contract is ``kernels.operations.Sweep``."""

import ctypes
from collections.abc import Sequence

import torch
from torch import Tensor

from structgstream.kernels.cuda_library import KernelLibrary
from structgstream.kernels.motion_types import SweepView, Swept
from structgstream.kernels.prototypes import addresses


class _View(ctypes.Structure):
    _fields_ = (
        ("colors", ctypes.c_void_p),
        ("missing", ctypes.c_void_p),
        ("depths", ctypes.c_void_p),
        ("viewmat", ctypes.c_void_p),
        ("K", ctypes.c_void_p),
        ("near_plane", ctypes.c_float),
        ("width", ctypes.c_int),
        ("height", ctypes.c_int),
    )


def sweep(
    library: KernelLibrary,
    views: Sequence[SweepView],
    view_index: int,
    pixels: Tensor,
    farthest: Tensor,
    *,
    planes: int,
    least_supports: int,
    most_contradictions: float,
) -> Swept:
    """See ``kernels.operations.Sweep``; float32. Results repeat bit for bit."""
    assert len(pixels) == len(farthest), (pixels.shape, farthest.shape)
    held = [[t.detach().float().contiguous() for t in (v.colors, v.missing, v.depths, v.viewmat, v.K)] for v in views]
    given = (_View * len(views))()
    for slot, view, tensors in zip(given, views, held, strict=True):
        library.check_devices(*tensors)
        slot.height, slot.width = view.missing.shape
        assert view.colors.shape == (slot.height, slot.width, 3), view.colors.shape
        assert view.depths.shape == view.missing.shape, view.depths.shape
        slot.colors, slot.missing, slot.depths, slot.viewmat, slot.K = addresses(*tensors)
        slot.near_plane = view.near
    pixels, farthest = pixels.to(torch.int64).contiguous(), farthest.float().contiguous()
    library.check_devices(pixels, farthest)
    votes = farthest.new_zeros(3, len(pixels), planes)
    found = Swept(torch.empty_like(farthest), torch.empty_like(farthest))
    library.call(
        "sgs_cuda_sweep",
        ctypes.addressof(given),
        len(views),
        view_index,
        *addresses(pixels, farthest),
        len(pixels),
        planes,
        least_supports,
        most_contradictions,
        *addresses(votes, found.depths, found.costs),
        device=farthest.device,
    )
    return found
