# SPDX-License-Identifier: Apache-2.0
"""Changed pixels in this package's C++; the contract is ``kernels.operations.ChangedPixels``."""

import torch
from torch import Tensor

from structgstream.errors import OutOfMemoryError
from structgstream.kernels._load import native_library
from structgstream.kernels.prototypes import addresses


def changed_pixels(before: Tensor, now: Tensor, *, threshold: float, reach_pixels: int) -> Tensor:
    """See ``kernels.operations.ChangedPixels``.

    Raises:
        OutOfMemoryError: there is no memory for three bytes per pixel.
    """
    assert before.shape == now.shape, (before.shape, now.shape)
    assert before.dtype == now.dtype == torch.uint8, (before.dtype, now.dtype)
    before, now = before.contiguous(), now.contiguous()
    height, width = now.shape[:2]
    changed = torch.empty(height, width, dtype=torch.uint8)
    failed = native_library().sgs_changed_pixels(
        *addresses(before, now), height, width, threshold, reach_pixels, *addresses(changed), torch.get_num_threads()
    )
    if failed:
        raise OutOfMemoryError("to compare two pictures")
    return changed.bool()
