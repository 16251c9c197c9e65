# SPDX-License-Identifier: Apache-2.0
"""Drawn as it was trained: sampling intervals, and pictures of other sizes than the training pictures'."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from structgstream.cameras import Camera, CameraRig
from structgstream.scene.render import render
from structgstream.scene.sampling import RigSampling
from structgstream.scene.scene import Scene
from tests.support.backends import quickest_backend
from tests.support.rigs import arc_rig, look_at, random_scene

BACKEND = quickest_backend()
RIG = arc_rig(width=96, height=64)


def camera_at(x: float, z: float, *, focal: float, size: int = 100) -> Camera:
    K = torch.tensor([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]], dtype=torch.float64)
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[0, 3], viewmat[2, 3] = -x, -z
    return Camera(viewmat, K, size, size)


def scene_of_needles() -> Scene:
    """Gaussians that are thinner than a pixel, as most of a trained scene are."""
    scene = random_scene(300, free=40)
    thin = replace(scene.anchors, log_base_scales=scene.anchors.log_base_scales - 2.5)
    free = replace(scene.free, log_scales=scene.free.log_scales - 2.5)
    return replace(scene, anchors=thin, free=free, sampling=RigSampling.of(RIG))


def picture(scene: Scene, camera: Camera) -> Tensor:
    return render(scene, camera, BACKEND).image


def reduced(image: Tensor, factor: int) -> Tensor:
    return torch.nn.functional.avg_pool2d(image.permute(2, 0, 1)[None], factor)[0].permute(1, 2, 0)


def decibels(one: Tensor, other: Tensor) -> float:
    return float(-10 * (one - other).square().mean().log10())


def test_an_interval_is_the_size_of_a_training_pixel() -> None:
    rig = CameraRig({"near": camera_at(0, 0, focal=50), "far": camera_at(0, -2, focal=50)})
    found = RigSampling.of(rig).intervals(torch.tensor([[0.0, 0.0, 2.0]]))
    assert found.item() == pytest.approx((2 / 50 + 4 / 50) / 2)
    finer = CameraRig({name: rig[name].resized(200, 200) for name in rig})
    assert RigSampling.of(finer).intervals(torch.tensor([[0.0, 0.0, 2.0]])).item() == pytest.approx(found.item() / 2)


def test_held_out_cameras_do_not_count() -> None:
    cameras = {"a": camera_at(0, 0, focal=50), "b": camera_at(0, 0, focal=50), "close": camera_at(0, 1.9, focal=50)}
    point = torch.tensor([[0.0, 0.0, 2.0]])
    assert RigSampling.of(CameraRig(cameras, frozenset({"close"}))).intervals(point).item() == pytest.approx(2 / 50)


def test_a_camera_counts_less_and_less_across_its_border() -> None:
    rig = CameraRig({"coarse": camera_at(0, 0, focal=50), "fine": camera_at(0, 0, focal=200)})
    # The fine camera sees points up to x = 0.25 at depth 1; points move across its border in steps of a thousandth.
    points = torch.stack([torch.linspace(0.0, 0.5, 501), torch.zeros(501), torch.ones(501)], dim=1)
    found = RigSampling.of(rig).intervals(points)
    assert found[0].item() == pytest.approx((1 / 50 + 1 / 200) / 2)
    assert found[-1].item() == pytest.approx(1 / 50, rel=1e-3)
    assert (found.diff() >= 0).all()
    assert found.diff().max() < 0.1 * (found[-1] - found[0])


def test_where_all_cameras_look_away_the_interval_is_zero_and_where_none_sees_it_is_finite() -> None:
    rig = CameraRig({"a": camera_at(0, 0, focal=50), "b": camera_at(1, 0, focal=50)})
    found = RigSampling.of(rig).intervals(torch.tensor([[0.0, 0.0, -1.0], [1e6, 0.0, 1.0], [0.0, 0.0, 0.0]]))
    assert found[0] == 0
    assert found[1].item() == pytest.approx(1 / 50, rel=1e-4)
    assert found[2] == 0


def test_intervals_are_computed_anew_after_a_change_in_place() -> None:
    sampling, points = RigSampling.of(RIG), torch.zeros(4, 3)
    first = sampling.intervals(points)
    assert sampling.intervals(points) is first
    points += 0.5
    assert not torch.equal(sampling.intervals(points), first)


def test_at_the_size_of_training_the_picture_is_what_was_trained() -> None:
    scene = scene_of_needles()
    for name in RIG.training:
        assert decibels(picture(scene, RIG[name]), picture(replace(scene, sampling=None), RIG[name])) > 35


@pytest.mark.parametrize("factor", [2, 3])
def test_a_larger_picture_averages_to_the_training_size(factor: int) -> None:
    scene, camera = scene_of_needles(), RIG["cam02"]
    large = camera.resized(factor * camera.width, factor * camera.height)
    found = decibels(reduced(picture(scene, large), factor), picture(scene, camera))
    plain = replace(scene, sampling=None)
    assert found > 38
    assert found > decibels(reduced(picture(plain, large), factor), picture(plain, camera)) + 8


@pytest.mark.parametrize("factor", [2, 4])
def test_a_smaller_picture_is_the_average_of_one_of_the_training_size(factor: int) -> None:
    scene, camera = scene_of_needles(), RIG["cam02"]
    small = camera.resized(camera.width // factor, camera.height // factor)
    found = decibels(picture(scene, small), reduced(picture(scene, camera), factor))
    plain = replace(scene, sampling=None)
    assert found > 28
    assert found > decibels(picture(plain, small), reduced(picture(plain, camera), factor)) + 5


@pytest.mark.parametrize("distance", [3e-3, 0.0, 0.05, 3e3])
@pytest.mark.parametrize("size", [1, 64])
def test_extreme_views_stay_finite(distance: float, size: int) -> None:
    """A thousand times nearer and farther than the rig's cameras, among the Gaussians, and pictures of one pixel."""
    scene = scene_of_needles()
    eye = torch.tensor([0.0, 0.0, -distance], dtype=torch.float64)
    K = torch.tensor([[40.0, 0, size / 2], [0, 40.0, size / 2], [0, 0, 1]], dtype=torch.float64)
    camera = Camera(look_at(eye, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)), K, size, size, near=1e-4)
    shown = picture(scene, camera)
    assert shown.isfinite().all()
    assert shown.min() >= 0
    assert shown.max() < 1.5


def test_what_the_low_pass_puts_into_a_picture_is_not_culled() -> None:
    """Seen from a tenth of the distance, Gaussians beyond the border reach into the picture by many pixels."""
    scene, camera = scene_of_needles(), RIG["cam02"]
    close = torch.eye(4, dtype=torch.float64)
    close[2, 3] = -2.7  # along the camera's axis
    near = replace(camera, viewmat=close @ camera.viewmat)
    everything = scene.gaussians(replace(near, width=near.width * 20, height=near.height * 20), BACKEND)
    wide = BACKEND.rasterize(everything, near.viewport(everything.means)).image
    assert torch.equal(picture(scene, near), wide)
