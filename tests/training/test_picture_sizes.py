# SPDX-License-Identifier: Apache-2.0
"""The same scene in pictures of twice the size is treated as the same scene: lengths in pixels are those of pictures of
the reference size, which is here that of the smaller ones."""

from dataclasses import replace

import pytest
import torch

from structgstream import cameras
from structgstream.cameras import Camera, CameraRig, enlargement
from structgstream.frames import MultiViewFrame
from structgstream.kernels.values import TILE_PIXELS
from structgstream.training.frame0.densify import MAX_ANCHORS, GrowthConfig
from structgstream.training.online.config import ExposureConfig, MotionConfig, SmoothnessConfig
from structgstream.training.online.exposure import exposure_reference
from structgstream.training.online.measure import measure
from structgstream.training.online.optimize import rest_every
from structgstream.training.online.preprocess import detect_changes
from structgstream.training.online.select import DynamicSelection, select_dynamic
from structgstream.training.online.smoothness import MotionSmoothness
from structgstream.training.online.split import DynamicSplit, find_active_tiles
from structgstream.training.parameters import pixel_size
from structgstream.training.residuals import baseline_residual
from structgstream.training.views import View, training_views
from tests.support.backends import quickest_backend
from tests.support.rigs import random_scene
from tests.support.worlds import moving_world

CPU = torch.device("cpu")
WIDTH, HEIGHT = 96, 64
CONFIG = MotionConfig(enabled=True, picture_scale=0.5, tiles_around=1)
WORLD = moving_world(2, width=WIDTH, height=HEIGHT, speed=0.06, movers=20)
SIZES = (1, 2)


@pytest.fixture(autouse=True)
def reference(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cameras, "REFERENCE_PIXELS", WIDTH)


def rig(times: int) -> CameraRig:
    return CameraRig(
        {name: WORLD.rig[name].resized(times * WIDTH, times * HEIGHT) for name in WORLD.rig}, WORLD.rig.held_out
    )


def views(number: int, times: int) -> list[View]:
    """The world's pictures, each pixel ``times`` as wide and as high."""
    images = {name: image.repeat(times, 0).repeat(times, 1) for name, image in WORLD.frames[number].images.items()}
    return training_views(MultiViewFrame(number, 0.0, images), rig(times), CPU)


def segmented(times: int, *, flow: bool = False) -> DynamicSelection:
    now, before, backend = views(1, times), views(0, times), quickest_backend()
    chosen = [view.index for view in now] if flow else []
    changes = detect_changes(now, before, config=CONFIG, backend=backend, flow_from=chosen)
    measured = measure(WORLD.scene, now, changes, config=CONFIG, backend=backend)
    return select_dynamic(WORLD.scene, measured, config=CONFIG, backend=backend)


def test_lengths_grow_above_the_reference_size_only() -> None:
    assert [enlargement(*size) for size in ((10, 5), (96, 64), (192, 64), (64, 192), (576, 300))] == [1, 1, 2, 2, 6]


def test_changed_pixels_reach_as_far_in_the_scene() -> None:
    found = [detect_changes(views(1, n), views(0, n), config=CONFIG, backend=quickest_backend()) for n in SIZES]
    for small, large in zip(*found, strict=True):
        assert small is not None
        assert large is not None
        doubled = small.changed.repeat_interleave(2, 0).repeat_interleave(2, 1)
        assert (doubled != large.changed).float().mean() < 0.03  # The 3 x 3 mean against noise stays as it is.
        assert 0.1 < large.changed.float().mean() < 0.9


def test_the_same_anchors_move() -> None:
    small, large = (segmented(n) for n in SIZES)
    assert 10 < int(small.anchors.sum()) < 50
    assert int((small.anchors != large.anchors).sum()) <= 4  # 11 if lengths stay as they are.
    for index, visible in small.visible.items():
        assert torch.equal(visible, large.visible[index])
        assert small.changed[index].shape == large.changed[index].shape


def test_flow_has_the_same_weights() -> None:
    pytest.importorskip("cv2")
    small, large = (segmented(n, flow=True).evidence for n in SIZES)
    assert small is not None
    assert large is not None
    known = (small.weights > 0.3) & (large.weights > 0.3)
    assert known.any()
    ratio = large.weights[known] / small.weights[known]
    assert 0.7 < float(ratio.median()) < 1.4


def test_the_tiles_that_are_drawn_reach_as_far() -> None:
    widths = []
    for times in SIZES:
        now = views(1, times)
        changed = {view.index: torch.zeros(HEIGHT // 2, WIDTH // 2, dtype=torch.bool) for view in now}
        for mask in changed.values():
            mask[12:16, 24:28] = True
        all_seen = {view.index: torch.ones(300, dtype=torch.bool) for view in now}
        every = torch.ones(60, dtype=torch.bool)
        selection = replace(segmented(times), anchors=every, changed=changed, visible=all_seen)
        split = DynamicSplit.of(WORLD.scene, selection)
        active_tiles = find_active_tiles(split, now, config=CONFIG, backend=quickest_backend())
        widths.append([int(active.tiles.mask.any(0).sum()) * TILE_PIXELS / times for active in active_tiles.values()])
    # One tile on each side of the one that changed at the reference size, two at twice the size.
    assert widths == [[3 * TILE_PIXELS] * 4, [2.5 * TILE_PIXELS] * 4]


def test_baselines_and_exposures_are_compared_at_one_size() -> None:
    backend = quickest_backend()
    baselines = [baseline_residual(WORLD.scene, views(0, n), scale=0.5, backend=backend).maps for n in SIZES]
    lights = [exposure_reference(WORLD.scene, views(0, n), config=ExposureConfig()).views for n in SIZES]
    for index in baselines[0]:
        torch.testing.assert_close(baselines[0][index], baselines[1][index], atol=1e-3, rtol=0.0)
        assert torch.equal(lights[0][index].image, lights[1][index].image)


def test_steps_and_slack_are_the_same_length_in_the_scene() -> None:
    scene = random_scene(60, cameras=4, seed=4)
    rigs = [[rig(n)[name] for name in WORLD.rig.training] for n in SIZES]
    small, large = (pixel_size(scene.anchors.positions, cameras_of) for cameras_of in rigs)
    assert small == pytest.approx(large, rel=1e-6)
    priced = [MotionSmoothness.of(scene, cameras_of, config=SmoothnessConfig(weight=1.0)) for cameras_of in rigs]
    moved = scene.anchors.positions.clone()
    moved[0, 0] += 0.05
    costs = [float(price.difference(moved, quickest_backend())) for price in priced if price is not None]
    assert costs[0] == pytest.approx(costs[1], rel=1e-5)
    assert costs[0] > 0.0


def test_larger_pictures_may_have_more_anchors() -> None:
    config = GrowthConfig(max_anchors=50_000)
    assert config.for_pictures(1.0) == config
    assert config.for_pictures(1.5).max_anchors == 75_000
    assert config.for_pictures(100.0).max_anchors == MAX_ANCHORS
    unbounded = GrowthConfig()
    assert unbounded.for_pictures(6.0) == unbounded


@pytest.mark.parametrize(("cameras_drawn", "expected"), [(9, 3), (27, 3), (46, 3), (60, 2), (100, 1), (200, 1)])
def test_every_view_is_drawn_whole_at_least_once(cameras_drawn: int, expected: int) -> None:
    assert rest_every(3, views=cameras_drawn, iterations=140) == expected


def test_cameras_of_several_sizes_have_each_their_own() -> None:
    mixed = [View(view.index, view.camera, view.image) for view in views(1, 1)]
    mixed[1] = views(1, 2)[1]
    before = views(0, 1)
    before[1] = views(0, 2)[1]
    backend = quickest_backend()
    changes = detect_changes(mixed, before, config=CONFIG, backend=backend)
    measured = measure(WORLD.scene, mixed, changes, config=CONFIG, backend=backend)
    found = select_dynamic(WORLD.scene, measured, config=CONFIG, backend=backend)
    assert int((found.anchors != segmented(1).anchors).sum()) <= 4


def test_a_picture_of_one_pixel_is_none_too_small() -> None:
    camera: Camera = WORLD.rig["cam01"].resized(1, 1)
    view = View(0, camera, torch.zeros(1, 1, 3, dtype=torch.uint8))
    assert view.evidence(0.25).image.shape == (1, 1, 3)
    assert view.reference_area == 1.0
