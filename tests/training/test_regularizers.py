# SPDX-License-Identifier: Apache-2.0
"""Regularizers of frame 0."""

import pytest
import torch

from rigs import arc_rig, random_scene
from structgstream.gaussians import Gaussians
from structgstream.kernels.backend import reference_backend
from structgstream.training.neighbours import nearest_others
from structgstream.training.regularizers import (
    RegularizerConfig,
    Regularizers,
    color_spread,
    depth_spread,
    feature_difference,
)

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


def spread(gaussians: Gaussians) -> torch.Tensor:
    return depth_spread(gaussians, CAMERA, reference_backend())


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


def in_colors(colors: list[float], opacities: list[float]) -> Gaussians:
    """Sheets of grey so wide that they cover every pixel alike."""
    found = sheets([2.0, 3.0][: len(colors)], opacities)
    grey = torch.tensor(colors)[:, None].expand(-1, 3).clone().requires_grad_()
    return Gaussians(**(vars(found) | {"scales": torch.full((len(colors), 3), 1e3), "colors": grey}))


def test_the_spread_of_color_is_the_variance_along_the_ray() -> None:
    weights, colors = torch.tensor([0.6, 0.4 * 0.99]), torch.tensor([0.2, 0.9])
    found = color_spread(in_colors([0.2, 0.9], [0.6, 0.99]), CAMERA, reference_backend()).item()
    expected = (weights * colors.square()).sum() - (weights * colors).sum().square()
    assert found == pytest.approx(expected.item(), rel=2e-3)


def test_the_spread_of_color_draws_layers_to_one_color() -> None:
    layers = in_colors([0.2, 0.9], [0.6, 0.99])
    (gradient,) = torch.autograd.grad(color_spread(layers, CAMERA, reference_backend()), [layers.colors])
    assert (gradient[0] < 0).all()
    assert (gradient[1] > 0).all()
    same = color_spread(in_colors([0.5, 0.5], [0.6, 0.99]), CAMERA, reference_backend()).item()
    assert same == pytest.approx(0.0, abs=2e-3)


def test_features_are_drawn_to_those_of_the_neighbors_which_stay() -> None:
    features = torch.tensor([[1.0], [0.0], [0.0]], requires_grad=True)
    value = feature_difference(features, torch.tensor([[1, 2], [2, 2], [1, 1]]))
    assert value.item() == pytest.approx(1 / 3)
    (gradient,) = torch.autograd.grad(value, [features])
    assert gradient[:, 0].tolist() == pytest.approx([2 / 3, 0.0, 0.0])


def test_when_they_count() -> None:
    config = RegularizerConfig(depth_spread=0.05, color_spread=1.5, feature_difference=0.1)
    anchors = random_scene(20, cameras=3, seed=1).anchors
    found = Regularizers(config, 100, reference_backend())
    terms = {n: found.terms(n, sheets([2.0, 3.0], [0.6, 0.9]), anchors, CAMERA) for n in range(1, 101)}
    assert [n for n, of in terms.items() if "depth_spread" in of] == list(range(32, 101, 4))
    assert [n for n, of in terms.items() if "color_spread" in of] == list(range(12, 101, 4))
    assert [n for n, of in terms.items() if "feature_difference" in of] == list(range(8, 101, 8))
    assert [terms[32][name][0] for name in ("depth_spread", "color_spread", "feature_difference")] == [0.2, 6.0, 0.8]
    assert not Regularizers(RegularizerConfig(), 100, reference_backend()).terms(
        40, sheets([2.0], [0.9]), anchors, CAMERA
    )


def test_neighbors_are_those_of_the_present_anchors() -> None:
    found = Regularizers(RegularizerConfig(feature_difference=1.0), 100, reference_backend())
    anchors = random_scene(20, cameras=3, seed=1).anchors
    fewer = anchors.select(torch.arange(20) < 12)
    for present in (anchors, fewer, anchors):
        _, value = found.terms(8, sheets([2.0], [0.9]), present, CAMERA)["feature_difference"]
        rows, _ = nearest_others(present.positions, 4)
        assert value.item() == pytest.approx(feature_difference(present.features, rows).item())
