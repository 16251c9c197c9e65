# SPDX-License-Identifier: Apache-2.0
"""Changed pixels in C++ beside the oracle: integers, so they agree exactly."""

import pytest
import torch

from structgstream.kernels import cpu_change, reference_change
from structgstream.kernels._load import native_reason

pytestmark = pytest.mark.skipif(native_reason() is not None, reason=str(native_reason()))


@pytest.mark.parametrize("size", [(1, 1), (2, 9), (37, 53), (64, 80)])
@pytest.mark.parametrize("reach_pixels", [0, 3])
def test_the_same_pixels(size: tuple[int, int], reach_pixels: int) -> None:
    g = torch.Generator().manual_seed(3)
    before = torch.randint(0, 256, (*size, 3), generator=g, dtype=torch.uint8)
    noise = torch.randint(-12, 13, (*size, 3), generator=g)
    noise[size[0] // 2 :, size[1] // 2 :] *= 3
    now = (before + noise).clamp(0, 255).to(torch.uint8)
    for threshold in (0.0, 0.02, 0.05, 1.0):
        ours = cpu_change.changed_pixels(before, now, threshold=threshold, reach_pixels=reach_pixels)
        theirs = reference_change.changed_pixels(before, now, threshold=threshold, reach_pixels=reach_pixels)
        assert torch.equal(ours, theirs)
