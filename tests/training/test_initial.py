# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from structgstream.errors import CaptureError
from structgstream.frames import MultiViewFrame
from structgstream.scene.scene import Scene
from structgstream.training.frame0.densify import GrowthConfig
from structgstream.training.frame0.fit import InitialConfig, InitialRates, fit_first_frame, rates_at
from structgstream.training.frame0.regularizers import DepthDistortionConfig, FreeSpaceConfig, in_free_space
from structgstream.training.frame0.seeding import seeded_scene, voxel_centers
from tests.support.backends import quickest_backend
from tests.support.streams import same
from tests.support.varied import varied
from tests.support.worlds import moving_world, psnr

QUICK = InitialConfig(
    iterations=120,
    schedule_iterations=120,
    voxel_size=0.05,
    growth=GrowthConfig(collect_from=20, start=40, stop=100, interval=20, eligible_count=4, prune_visits=8),
)


def fit(world, *, config=QUICK, frame=None, points=None):
    points = world.scene.anchors.positions if points is None else points
    return fit_first_frame(
        frame or world.frames[0], world.rig, points, config=config, backend=quickest_backend(), seed=0
    )


def test_a_held_out_camera_is_reproduced() -> None:
    world = moving_world(1)
    result, picture = fit(world), world.frames[0].images["cam00"]
    black = psnr(np.zeros_like(picture), picture)
    assert world.psnr(result.scene) > black + 6.0
    assert result.train_psnr > black + 8.0
    assert len(result.scene.free) == 0


def test_anchors_grow_where_points_are_missing() -> None:
    world = moving_world(1)
    few = world.scene.anchors.positions[:12]
    result = fit(world, points=few, config=replace(QUICK, growth=replace(QUICK.growth, grad_threshold=5e-5)))
    assert len(result.scene.anchors) > 12


def test_coarse_seeds_lie_on_the_fine_grid() -> None:
    world = moving_world(1)
    config = replace(QUICK, iterations=5, seed_voxels=3)
    anchors = fit(world, config=config).scene.anchors
    assert len(anchors) == len(voxel_centers(world.scene.anchors.positions, 0.15)) < 60
    cells = anchors.positions / QUICK.voxel_size
    assert torch.allclose(cells, cells.round(), atol=1e-3)


def test_exposures_are_learned_with_their_gauge() -> None:
    world = moving_world(1)
    dark = world.rig.training[0]
    images = dict(world.frames[0].images)
    images[dark] = (images[dark] * 0.7).astype(np.uint8)
    rates = replace(InitialRates(), camera_color=(0.02, InitialRates().camera_color[1]))
    config = replace(QUICK, camera_color=True, rates=rates)
    color = fit(world, frame=MultiViewFrame(0, 0.0, images), config=config).scene.camera_color
    assert color.gains[0].mean() < color.gains[1:].mean() - 0.05
    assert torch.allclose(color.gains.mean(0), torch.ones(3), atol=1e-5)
    assert torch.allclose(color.biases.mean(0), torch.zeros(3), atol=1e-5)


def test_small_pictures_first() -> None:
    world = moving_world(1)
    assert fit(world, config=replace(QUICK, coarse_iterations=60, medium_iterations=20)).train_psnr > 15.0


def test_stages_of_a_fit_that_begins_late() -> None:
    config = replace(QUICK, coarse_iterations=50, medium_iterations=30)
    for done, counts in ((0, (50, 30)), (20, (30, 30)), (60, (0, 20)), (100, (0, 0))):
        assert config.stages(done=done) == [(counts[0], 0.5), (counts[1], 0.7)]


def test_solid_surfaces() -> None:
    world = moving_world(1)
    result = fit(world, config=replace(QUICK, depth_distortion=DepthDistortionConfig(weight=0.05)))
    assert result.train_psnr > 15.0
    assert result.losses["depth_distortion"] > 0.0
    seeds = len(voxel_centers(world.scene.anchors.positions, 0.05))
    assert len(result.scene.anchors) == seeds + result.grown - result.removed


def test_what_floats_before_surfaces_is_removed_in_the_end_and_nothing_else_changes() -> None:
    world = moving_world(1)
    surface = world.scene.anchors.positions
    centers = torch.stack([world.rig[name].center for name in world.rig.training]).float()
    between = 0.6 * centers.mean(0) + 0.4 * surface.mean(0) + 0.02 * torch.randn(20, 3, generator=torch.manual_seed(1))
    points = torch.cat([surface, between])
    removing = replace(QUICK, floaters=varied(FreeSpaceConfig(enabled=True), MIN_CAMERAS=2, DRAWN_OPACITY=2.0))
    kept, found = fit(world, points=points), fit(world, points=points, config=removing)
    views = world.views()
    floating = in_free_space(kept.scene, views, config=removing.floaters, backend=quickest_backend())
    assert floating.any()
    assert found.counts == {"floaters": int(floating.sum())}
    assert found.removed == kept.removed + int(floating.sum())
    assert not kept.counts
    for name, value in vars(kept.scene.anchors.select(~floating)).items():
        assert value is None or torch.equal(getattr(found.scene.anchors, name), value)
    assert found.train_psnr == kept.train_psnr


def test_the_same_seed_gives_the_same_bits() -> None:
    world = moving_world(1)
    config = replace(QUICK, iterations=25)
    assert same(*(fit(world, config=config).scene for _ in range(2)))


def test_rates_of_the_reference_schedule() -> None:
    """Scaffold-GS at iteration 4,000 of 30,000, where the paper stops (offset rate without the extent)."""
    rates = rates_at(4000, InitialConfig(), extent=1.0)
    assert rates["anchor_offsets"] == pytest.approx(0.00541, rel=2e-3)
    assert rates["opacity_mlp"] == pytest.approx(0.00108, rel=3e-3)
    assert rates["color_mlp"] == pytest.approx(0.00406, rel=3e-3)
    assert rates["covariance_mlp"] == 0.004
    assert "anchor_positions" not in rates, "they are fixed"


def test_a_frame_0_without_anchors_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    """Anchors that stay transparent are pruned; a stream of nothing would be written without a word."""

    def transparent(*arguments: Any, **options: Any) -> Scene:
        scene = seeded_scene(*arguments, **options)
        head = scene.mlps.opacity
        head = head._replace(w2=torch.zeros_like(head.w2), b2=torch.full_like(head.b2, -9.0))
        return replace(scene, mlps=scene.mlps._replace(opacity=head))

    monkeypatch.setattr("structgstream.training.frame0.fit.seeded_scene", transparent)
    with pytest.raises(CaptureError, match=r"lost all of its \d+ anchors in training"):
        fit(moving_world(1))
