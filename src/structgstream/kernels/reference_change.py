# SPDX-License-Identifier: Apache-2.0
"""Which pixels changed between two pictures of one camera, in pure torch: the oracle."""

import torch
from torch import Tensor


def changed_pixels(before: Tensor, now: Tensor, *, threshold: float, reach_pixels: int) -> Tensor:
    """See ``kernels.operations.ChangedPixels``."""
    difference = (before.to(torch.int32) - now.to(torch.int32)).abs().sum(-1).float()[None, None]  # exact
    ones = torch.ones(1, 1, 3, 3, device=difference.device)
    sums = torch.nn.functional.conv2d(difference, ones, padding=1)
    counts = torch.nn.functional.conv2d(torch.ones_like(difference), ones, padding=1)
    limit = torch.tensor(threshold, dtype=torch.float32) * (255 * 3 * counts)
    marks = (sums > limit).float()
    size = 2 * reach_pixels + 1
    return torch.nn.functional.max_pool2d(marks, size, stride=1, padding=reach_pixels)[0, 0] > 0
