# SPDX-License-Identifier: Apache-2.0
"""Baking: what does not depend on the camera stays, what does is averaged and fitted as stated."""

from dataclasses import replace

import pytest
import torch

from structgstream.errors import StreamError
from structgstream.exporters.bake import bake, with_low_pass
from structgstream.geometry import quaternion_matrices
from structgstream.scene.render import Drawable, render
from structgstream.scene.sampling import RigSampling
from structgstream.scene.scene import Scene
from tests.support.backends import quickest_backend
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
    assert gaussians.sampling_intervals is not None
    wanted = (gaussians.scales**2 + 0.3 * gaussians.sampling_intervals[:, None] ** 2).sqrt()
    torch.testing.assert_close(found.scales, wanted, rtol=1e-5, atol=0)
    # Twenty times as large a viewer's own low-pass is next to nothing: 0.3 of its pixels are 0.00075 of ours.
    name = RIG.training[0]
    large = RIG[name].resized(20 * RIG[name].width, 20 * RIG[name].height)
    shown, exported, plain = (
        render(model, large, BACKEND).image for model in (thin, found, bake(thin, CAMERAS, BACKEND))
    )
    assert (shown - exported).abs().mean() < 0.15 * (shown - plain).abs().mean()
