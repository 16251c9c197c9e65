# SPDX-License-Identifier: Apache-2.0
"""Correlation through planes: the C++ against the oracle."""

import pytest
import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from structgstream.kernels import cpu_motion, reference_motion
from tests.support.backends import needs_native

pytestmark = needs_native
HEIGHT, WIDTH = 37, 53  # No multiple of any vector.


def picture(seed: int, height: int = HEIGHT, width: int = WIDTH) -> Tensor:
    """Noise with some correlation from pixel to pixel."""
    noise = torch.rand(1, 1, height + 2, width + 2, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return avg_pool2d(noise, 3, 1)[0, 0]


def homographies(planes: int, neighbours: int, *, behind: float = 0.0) -> Tensor:
    """Near the identity, with shifts of some pixels; of a share ``behind`` all pixels lie behind the neighbour."""
    generator = torch.Generator().manual_seed(5)
    found = torch.eye(3, dtype=torch.float64).repeat(planes, neighbours, 1, 1)
    found += 0.02 * torch.randn(found.shape, generator=generator, dtype=torch.float64)
    found[..., 2, :2] *= 0.01
    found[..., :2, 2] += 4.0 * torch.randn(planes, neighbours, 2, generator=generator, dtype=torch.float64)
    found[torch.rand(planes, neighbours, generator=generator) < behind] *= -1.0
    return found


@pytest.mark.parametrize("neighbours", [1, 2, 3, 4, 5])
@pytest.mark.parametrize("window", [3, 5, 7])
def test_scores(isa: int, neighbours: int, window: int) -> None:
    own, warps = picture(0), homographies(6, neighbours, behind=0.1)
    others = [picture(n + 1, 30 + n, 61 - n) for n in range(neighbours)]
    others[0] = own
    exact = reference_motion.plane_scores(own, others, warps, window=window, noise=1e-4)
    ours = cpu_motion.plane_scores(own, others, warps, window=window, noise=1e-4)
    assert ours.shape == exact.shape == (6, HEIGHT, WIDTH)
    assert exact.std() > 0.1
    # Where a sample falls onto the edge of a picture rounding decides whether it is seen.
    apart = (ours - exact).abs() > 2e-4
    assert apart.float().mean() < 2e-3
    assert ours.min() >= -1.0
    assert ours.max() <= 1.0 + 1e-5


def test_a_picture_correlates_with_itself(isa: int) -> None:
    own = picture(0)
    scores = cpu_motion.plane_scores(own, [own], torch.eye(3).repeat(1, 1, 1, 1), window=5, noise=0.0)
    torch.testing.assert_close(scores[0], torch.ones(HEIGHT, WIDTH), atol=1e-3, rtol=0)


@pytest.mark.parametrize("size", [(1, 1), (1, 9), (9, 1), (2, 2)])
def test_tiny_pictures(isa: int, size: tuple[int, int]) -> None:
    """Windows are wider than the picture: its mirror images are mirrored again."""
    own, warps = picture(0, *size), torch.eye(3).repeat(1, 2, 1, 1)
    given = own, [own, picture(1, *size)], warps
    exact = reference_motion.plane_scores(*given, window=7, noise=1e-3)
    torch.testing.assert_close(cpu_motion.plane_scores(*given, window=7, noise=1e-3).double(), exact, atol=1e-4, rtol=0)


def test_no_planes(isa: int) -> None:
    found = cpu_motion.plane_scores(picture(0), [picture(1)], torch.zeros(0, 1, 3, 3), window=3, noise=1e-3)
    assert found.shape == (0, HEIGHT, WIDTH)
