# SPDX-License-Identifier: Apache-2.0
"""Baking: what does not depend on the camera stays, what does is averaged and fitted; plain Gaussians."""

import math
from dataclasses import replace

import pytest
import torch

from structgstream.cameras import Similarity
from structgstream.errors import StreamError
from structgstream.exporters.bake import BakedGaussians, bake, with_low_pass
from structgstream.geometry import quaternion_matrices
from structgstream.harmonics import Y0
from structgstream.kernels.backend import reference_backend
from structgstream.scene.render import Drawable, render
from structgstream.scene.sampling import RigSampling
from structgstream.scene.scene import Scene
from tests.support.backends import quickest_backend
from tests.support.plain import some
from tests.support.rigs import arc_rig, random_scene

RIG = arc_rig(6, width=64, height=48)
CAMERAS = [RIG[name] for name in RIG.training]
BACKEND = quickest_backend()


def distance(one: Drawable, other: Drawable, names: tuple[str, ...] = RIG.training) -> float:
    """PSNR, dB, of what both show to cameras of the rig."""
    errors = [
        (render(one, RIG[n], BACKEND).image - render(other, RIG[n], BACKEND).image).square().mean() for n in names
    ]
    return float(-10.0 * torch.stack(errors).mean().log10())


@pytest.fixture(scope="module")
def scene() -> Scene:
    return random_scene(60, free=5, cameras=5, seed=4)


@pytest.mark.parametrize("degree", [0, 1, 2])
def test_free_gaussians_stay_as_they_are(degree: int) -> None:
    scene = random_scene(0, free=7, cameras=5)
    found = bake(scene, CAMERAS, BACKEND, degree=degree)
    wanted = scene.free_gaussians()
    torch.testing.assert_close(found.means, wanted.means)
    torch.testing.assert_close(found.opacities, wanted.opacities)
    torch.testing.assert_close(found.colors(torch.tensor([0.3, 2.0, -1.0])), wanted.colors, atol=1e-4, rtol=1e-4)
    axes, wanted_axes = (quaternion_matrices(g.quats) * g.scales[:, None] for g in (found, wanted))
    torch.testing.assert_close(axes @ axes.mT, wanted_axes @ wanted_axes.mT, atol=1e-6, rtol=1e-4)


def test_for_one_camera_nothing_is_lost(scene: Scene) -> None:
    found = bake(scene, CAMERAS[:1], BACKEND, degree=0)
    assert distance(found, scene, RIG.training[:1]) > 55


def test_pictures_are_close_and_a_degree_more_is_closer(scene: Scene) -> None:
    flat, linear = (bake(scene, CAMERAS, BACKEND, degree=degree) for degree in (0, 1))
    assert flat.degree == 0
    assert linear.degree == 1
    assert distance(flat, scene) > 25
    assert distance(linear, scene) > distance(flat, scene) + 0.3
    assert distance(linear, scene, RIG.testing) > 25


def test_averages_are_what_the_cameras_draw(scene: Scene) -> None:
    """Against a dictionary of ids, filled one Gaussian at a time."""
    drawn: dict[int, list[tuple[float, torch.Tensor]]] = {}
    seen: dict[int, int] = {}
    for camera in CAMERAS:
        structured = scene.structured(camera, BACKEND)
        for anchor in structured.anchors.tolist():
            for offset in range(scene.anchors.offsets_per_anchor):
                number = anchor * scene.anchors.offsets_per_anchor + offset
                seen[number] = seen.get(number, 0) + 1
        generated = structured.gaussians
        for i, number in enumerate(generated.ids.tolist()):
            drawn.setdefault(number, []).append((float(generated.opacities[i]), generated.scales[i].log()))
    structured = replace(scene, free=random_scene(0).free)
    over_seen = {number: sum(o for o, _ in found) / seen[number] for number, found in drawn.items()}
    found = bake(structured, CAMERAS, BACKEND)
    kept = sorted(number for number, value in over_seen.items() if value >= 1 / 255)
    torch.testing.assert_close(found.opacities, torch.tensor([over_seen[number] for number in kept]))
    logs = [sum(o * s for o, s in drawn[n]) / sum(o for o, _ in drawn[n]) for n in kept]
    torch.testing.assert_close(found.scales, torch.stack([torch.as_tensor(entry) for entry in logs]).exp())


def test_a_scene_without_gaussians_is_refused() -> None:
    with pytest.raises(StreamError, match="nothing to export"):
        bake(random_scene(0, cameras=5), CAMERAS, BACKEND)


def test_a_low_pass_makes_an_export_look_as_trained_where_viewers_add_none() -> None:
    """Variances add up: a viewer that adds nothing shows what ours draws with the low-pass of the training pictures."""
    scene = replace(random_scene(0, free=40, cameras=5, seed=4), sampling=RigSampling.of(RIG))
    thin = replace(scene, free=replace(scene.free, log_scales=scene.free.log_scales - 2.0))
    sampling = RigSampling.of(RIG)
    found = with_low_pass(bake(thin, CAMERAS, BACKEND), sampling, 0.3)
    gaussians = thin.free_gaussians()
    wanted = (gaussians.scales**2 + 0.3 * gaussians.sampling_intervals[:, None] ** 2).sqrt()
    torch.testing.assert_close(found.scales, wanted, rtol=1e-5, atol=0)
    # Twenty times as large a viewer's own low-pass is next to nothing: 0.3 of its pixels are 0.00075 of ours.
    name = RIG.training[0]
    large = RIG[name].resized(20 * RIG[name].width, 20 * RIG[name].height)
    shown, exported, plain = (
        render(model, large, BACKEND).image for model in (thin, found, bake(thin, CAMERAS, BACKEND))
    )
    assert (shown - exported).abs().mean() < 0.15 * (shown - plain).abs().mean()


def two(sh: torch.Tensor) -> BakedGaussians:
    """At ``z`` = 2 and at ``x`` = 2."""
    return BakedGaussians(
        means=torch.tensor([[0.0, 0.0, 2.0], [2.0, 0.0, 0.0]]),
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0], [0.6, 0.8, 0.0, 0.0]]),
        scales=torch.tensor([[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]]),
        opacities=torch.tensor([0.3, 0.9]),
        sh=sh,
    )


def test_colours_by_hand() -> None:
    """Seen from the origin along ``z`` and ``x``: their harmonics are ``sqrt(3 / 4 pi)`` times 1 and -1."""
    sh = torch.zeros(2, 4, 3)
    sh[:, 0, 0], sh[:, 2, 1], sh[:, 3, 2] = 1.0, 0.5, 0.25
    sh[:, 0, 2] = -0.4
    first = math.sqrt(3 / (4 * math.pi))
    red, blue = 0.5 + Y0, 0.5 - 0.4 * Y0
    expected = [[red, 0.5 + 0.5 * first, blue], [red, 0.5, blue - 0.25 * first]]
    torch.testing.assert_close(two(sh).colors(torch.zeros(3)), torch.tensor(expected))
    sh[:, 0] = -9.0
    assert torch.equal(two(sh).colors(torch.zeros(3)), torch.zeros(2, 3)), "cut off at 0"


def test_a_camera_sees_the_colours_of_its_place() -> None:
    sh = torch.randn(2, 4, 3, generator=torch.Generator().manual_seed(0)) * 0.2
    camera = arc_rig()["cam01"]
    seen = two(sh).gaussians(camera, reference_backend())
    assert torch.equal(seen.colors, two(sh).colors(camera.center.float()))
    assert seen.ids.tolist() == [0, 1]


def test_y_up_shows_the_same_to_a_camera_that_is_turned_alike() -> None:
    gaussians = some(20, degree=3)
    center = torch.tensor([0.3, 2.0, -4.0])
    turned = gaussians.y_up()
    half_turn = torch.tensor([1.0, -1.0, -1.0])
    torch.testing.assert_close(turned.colors(center * half_turn), gaussians.colors(center))
    axes, wanted = (quaternion_matrices(g.quats) * g.scales[:, None] for g in (turned, gaussians))
    turn = torch.diag(half_turn)
    torch.testing.assert_close(axes @ axes.mT, turn @ wanted @ wanted.mT @ turn)


def test_in_the_units_of_the_capture() -> None:
    """Normalised = (capture - center) * scale, so back it is divided and moved; axes and colours stay."""
    both = two(torch.zeros(2, 1, 3))
    found = both.in_capture_units(Similarity((1.0, -2.0, 3.0), 0.5))
    torch.testing.assert_close(found.means, torch.tensor([[1.0, -2.0, 7.0], [5.0, -2.0, 3.0]]))
    torch.testing.assert_close(found.scales, both.scales * 2.0)
    assert found.quats is both.quats
    assert found.means.dtype == torch.float32
