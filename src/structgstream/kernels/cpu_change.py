# SPDX-License-Identifier: Apache-2.0
"""Changed pixels in this package's C++; the contract is ``kernels.reference_change``'s."""

import ctypes

import torch
from torch import Tensor

from structgstream.errors import OutOfMemoryError
from structgstream.kernels._load import native_library


def changed_pixels(before: Tensor, now: Tensor, *, threshold: float, reach_pixels: int) -> Tensor:
    """Mask ``[H, W]`` of what changed, see ``kernels.reference_change.changed_pixels``.

    Raises:
        OutOfMemoryError: there is no room for three bytes a pixel.
    """
    assert before.shape == now.shape, (before.shape, now.shape)
    assert before.dtype == now.dtype == torch.uint8, (before.dtype, now.dtype)
    before, now = before.contiguous(), now.contiguous()
    height, width = now.shape[:2]
    changed = torch.empty(height, width, dtype=torch.uint8)
    failed = native_library().sgs_changed_pixels(
        ctypes.c_void_p(before.data_ptr()),
        ctypes.c_void_p(now.data_ptr()),
        ctypes.c_int(height),
        ctypes.c_int(width),
        ctypes.c_float(threshold),
        ctypes.c_int(reach_pixels),
        ctypes.c_void_p(changed.data_ptr()),
        ctypes.c_int(torch.get_num_threads()),
    )
    if failed:
        raise OutOfMemoryError("to compare two pictures")
    return changed.bool()
