# SPDX-License-Identifier: Apache-2.0
"""The spread of depth along rays."""

import pytest
import torch

from structgstream.gaussians import Gaussians
from structgstream.kernels.backend import reference_backend
from structgstream.training.frame0.regularizers import DepthDistortionConfig, depth_distortion
from tests.support.rigs import arc_rig

RIG = arc_rig()
CAMERA = RIG["cam01"]
FORWARD = CAMERA.viewmat[2, :3].float()
CENTER = torch.linalg.inv(CAMERA.viewmat)[:3, 3].float()


def sheets(depths: list[float], opacities: list[float]) -> Gaussians:
    """Wide Gaussians in front of the camera, one behind the other."""
    n = len(depths)
    means = CENTER + torch.tensor(depths)[:, None] * FORWARD
    return Gaussians(
        means=means.requires_grad_(),
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]]).expand(n, 4),
        scales=torch.full((n, 3), 3.0),
        opacities=torch.tensor(opacities).requires_grad_(),
        colors=torch.zeros(n, 3),
        ids=torch.arange(n),
    )


def spread(gaussians: Gaussians, *, scale: float = 1.0) -> torch.Tensor:
    return depth_distortion(gaussians, CAMERA, scale=scale, backend=reference_backend())


def test_one_surface_has_no_spread() -> None:
    assert spread(sheets([3.0], [0.9])).item() == pytest.approx(0.0, abs=2e-3)


def test_two_half_seen_surfaces_have_the_deviation_of_their_depths() -> None:
    wide = 1e3  # so wide that their opacity is the same in every pixel
    found = sheets([2.0, 3.0], [0.6, 0.99])
    found = Gaussians(**(vars(found) | {"scales": torch.full((2, 3), wide)}))
    weights = torch.tensor([0.6, 0.4 * 0.99])
    depths = torch.tensor([2.0, 3.0])
    mean = (weights * depths).sum() / weights.sum()
    deviation = ((weights * depths.square()).sum() / weights.sum() - mean.square()).sqrt()
    assert spread(found).item() == pytest.approx((deviation / mean).item(), rel=2e-3)
    assert spread(found, scale=0.5).item() == pytest.approx((deviation / mean).item(), rel=2e-3)


def test_it_pulls_gaussians_together_and_makes_the_one_before_opaque() -> None:
    found = sheets([2.0, 3.0], [0.7, 0.9])
    means, opacities = torch.autograd.grad(spread(found), [found.means, found.opacities])
    along = means @ FORWARD
    assert along[0] < 0 < along[1]  # Descent moves the first one away from the camera, the second towards it.
    assert opacities[0] < 0 < opacities[1]


def test_nothing_drawn_is_no_spread_and_no_nan() -> None:
    found = sheets([2.0, 3.0], [0.01, 0.02])
    result = spread(found)
    assert result.item() == 0.0
    assert all(torch.isfinite(gradient).all() for gradient in torch.autograd.grad(result, [found.means]))


def test_when_it_counts() -> None:
    config = DepthDistortionConfig(weight=0.05)
    counts = [config.weight_at(iteration, 100) for iteration in range(1, 101)]
    assert not any(counts[:30])
    assert counts[31] == pytest.approx(0.2)
    assert sum(counts) / 70 == pytest.approx(0.05, rel=0.05)
    assert DepthDistortionConfig().weight_at(80, 100) == 0.0
