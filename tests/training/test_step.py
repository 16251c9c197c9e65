# SPDX-License-Identifier: Apache-2.0
import pytest
import torch

from rigs import arc_rig, random_scene
from structgstream.kernels.backend import reference_backend
from structgstream.training.losses import LossWeights
from structgstream.training.parameters import Parameters
from structgstream.training.step import view_loss, with_term
from structgstream.training.stopwatch import Stopwatch
from structgstream.training.views import View

CPU = torch.device("cpu")


def loss_of(parameters, scene, **weights):
    view = View(0, arc_rig()["cam01"], torch.full((32, 48, 3), 90, dtype=torch.uint8))
    loss = view_loss(
        parameters.scene(scene),
        view,
        backend=reference_backend(),
        weights=LossWeights(**weights),
        voxel_size=0.01,
        track_screen=True,
        watch=Stopwatch(CPU),
    )
    return loss, view


def test_the_total_is_the_weighted_sum_of_the_papers_terms() -> None:
    scene = random_scene(free=3)
    parameters = Parameters.of(scene, trained=frozenset())
    loss, view = loss_of(parameters, scene, offset_distance=0.005)
    image, target = loss.image, view.image / 255.0
    scales = loss.rendering.gaussians.scales
    expected = (
        (image - target).abs().mean()
        + 0.2 * loss.terms["ssim"]
        + 0.01 * scales.prod(1).mean()
        + 0.005 * loss.terms["offset_distance"]
    )
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
