# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import pytest
import torch

from structgstream.kernels.backend import reference_backend
from structgstream.kernels.reference_losses import l1_ssim as reference_l1_ssim
from structgstream.kernels.values import TileSelection
from structgstream.scene.active_tiles import ActiveTiles
from structgstream.scene.color import CameraColor
from structgstream.scene.render import draw
from structgstream.training.losses import LossWeights, picture_loss, view_loss, with_term
from structgstream.training.parameters import Parameters
from structgstream.training.result import Stopwatch
from structgstream.training.views import View, blackened
from tests.support.backends import quickest_backend
from tests.support.rigs import arc_rig, random_scene


def loss_of(parameters, scene, *, grey=90, index=0, **weights):
    view = View(index, arc_rig()["cam01"], torch.full((32, 48, 3), grey, dtype=torch.uint8))
    loss = view_loss(
        parameters.scene(scene),
        view,
        backend=reference_backend(),
        weights=LossWeights(**weights),
        track_screen=True,
        watch=Stopwatch(),
    )
    return loss, view


def test_the_total_is_the_weighted_sum_of_the_papers_terms() -> None:
    scene = random_scene(free=3)
    parameters = Parameters.of(scene, trained=frozenset())
    loss, view = loss_of(parameters, scene)
    image, target = loss.rendering.image * loss.gains + loss.biases, view.image / 255.0
    scales = loss.rendering.gaussians.scales
    expected = (image - target).abs().mean() + 0.2 * loss.terms["ssim"] + 0.01 * scales.prod(1).mean()
    assert loss.total.item() == pytest.approx(expected.item(), rel=1e-5)


def test_weights_of_zero_are_not_computed() -> None:
    scene = random_scene()
    loss, _ = loss_of(Parameters.of(scene, trained=frozenset()), scene, volume=0.0)
    assert set(loss.terms) == {"l1", "ssim"}


def test_a_further_term_counts_by_its_weight() -> None:
    scene = random_scene()
    loss, _ = loss_of(Parameters.of(scene, trained=frozenset()), scene)
    more = with_term(loss, "more", torch.tensor(2.0), weight=0.25)
    assert more.total.item() == pytest.approx(loss.total.item() + 0.5)
    assert (more.terms["more"].item(), "more" in loss.terms) == (2.0, False)
    assert more.structured is loss.structured


@pytest.mark.parametrize("focused", [False, True])
@pytest.mark.parametrize("learned", [False, True])
def test_masked_pixels_have_no_influence_on_loss_and_gradient(learned: bool, focused: bool) -> None:
    """Against the definition in plain torch: both pictures black where the mask is False, means over all pixels."""
    backend, weights = quickest_backend(), LossWeights(volume=0.0)
    generator = torch.Generator().manual_seed(3)
    camera = arc_rig(width=96, height=64)["cam01"]
    mask = torch.rand(64, 96, generator=generator) > 0.3
    mask[10:30, 20:50] = False
    noise = torch.randint(0, 256, (2, 64, 96, 3), generator=generator).to(torch.uint8)
    truth = blackened(noise[0], mask)
    color = CameraColor(torch.full((1, 3), 0.9).requires_grad_(learned), torch.full((1, 3), 0.02))
    scene = random_scene(60)
    gaussians = scene.gaussians(camera, backend)
    colors = gaussians.colors.detach().requires_grad_()
    tiles = TileSelection(torch.arange(24).reshape(4, 6) % 3 > 0, 96, 64)
    drawn = draw(gaussians, camera, backend).image.detach()
    none = gaussians.select(torch.zeros(len(gaussians), dtype=torch.bool))
    active = ActiveTiles(tiles, drawn.clone(), none, changed=tiles)
    loss = picture_loss(
        replace(gaussians, colors=colors),
        View(0, camera, truth, mask),
        color,
        backend=backend,
        weights=weights,
        track_screen=False,
        watch=Stopwatch(),
        active=active if focused else None,
    )
    (found,) = torch.autograd.grad(loss.total, colors)

    image = draw(replace(gaussians, colors=colors), camera, backend).image * color.gains[0] + color.biases[0]
    shown = torch.where(mask[..., None], image, torch.zeros(()))
    l1, similarity = reference_l1_ssim(shown, truth, tiles=tiles if focused else None)
    expected = weights.l1 * l1 + weights.ssim * (1 - similarity)
    assert loss.total.item() == pytest.approx(expected.item(), rel=1e-4)
    (gradient,) = torch.autograd.grad(expected, colors)
    torch.testing.assert_close(found, gradient, rtol=1e-3, atol=1e-6)

    squares = (image.clamp(0, 1) - truth / 255.0).square()[mask & tiles.pixels() if focused else mask]
    assert loss.squared_error(View(0, camera, truth, mask)).item() == pytest.approx(squares.mean().item(), rel=1e-4)
