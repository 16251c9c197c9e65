# SPDX-License-Identifier: Apache-2.0
"""Frames after the first, in a world whose motion is known."""

from dataclasses import replace

import pytest
import torch

from structgstream.kernels.backend import Backend
from structgstream.scene.scene import Scene
from structgstream.scene.state import PAPER_DYNAMIC, FieldName, state_of
from structgstream.training.online.config import (
    MotionConfig,
    OnlineConfig,
    OnlineRates,
    PatchingConfig,
    SceneFlowConfig,
    SmoothnessConfig,
)
from structgstream.training.online.fit import fit_next_frame
from structgstream.training.online.patching import IDS_PER_FRAME
from structgstream.training.online.preprocess import preprocess
from structgstream.training.online.split import with_displacements
from structgstream.training.result import Step
from tests.support.backends import quickest_backend
from tests.support.streams import same
from tests.support.varied import varied
from tests.support.worlds import moving_world

QUICK = OnlineConfig(
    iterations=24,
    rates=varied(OnlineRates(), ANCHOR_POSITIONS=2e-3),
    patching=PatchingConfig(iteration=12, grad_threshold=1e-3),
)


def without_patching(config: OnlineConfig) -> OnlineConfig:
    """The paper's baseline of its free-3DG ablation."""
    return replace(config, patching=replace(config.patching, spawn="off"))


def fit(scene, world, index, *, config=QUICK, seed=0, **options):
    frame, backend = world.frames[index], quickest_backend()
    return fit_next_frame(scene, frame, world.rig, config=config, backend=backend, seed=seed, **options)


def test_anchors_follow_motion() -> None:
    world = moving_world(2)
    result = fit(world.scene, world, 1, config=without_patching(QUICK))
    assert world.psnr(result.scene, 1) > world.psnr(world.scene, 1) + 3.0
    moved = (result.scene.anchors.positions - world.scene.anchors.positions).mean(0)
    assert moved[0] > 0.015  # The truth is 0.03.
    assert moved[1:].abs().max() < 0.01


def test_neighbours_move_more_alike_where_that_has_a_price() -> None:
    world = moving_world(2)
    free = fit(world.scene, world, 1, config=without_patching(QUICK))
    config = replace(without_patching(QUICK), smoothness=SmoothnessConfig(weight=3e-3))
    priced = fit(world.scene, world, 1, config=config)

    def scatter(scene: Scene) -> float:
        moved = scene.anchors.positions - world.scene.anchors.positions
        return float(moved.std(0).norm())

    assert scatter(priced.scene) < 0.7 * scatter(free.scene)
    assert world.psnr(priced.scene, 1) > world.psnr(free.scene, 1) - 0.3
    assert priced.losses["smoothness"] > 0.0
    assert "smoothness" not in free.losses


def test_an_emerging_object_gains_free_gaussians() -> None:
    """With the paper's rates, free Gaussians gain what anchors alone cannot show, and are inherited."""
    world = moving_world(5, emerges_at=1, speed=0.0)
    config = OnlineConfig(iterations=60, patching=PatchingConfig(iteration=30, grad_threshold=5e-3))
    full = alone = world.scene
    kept: set[int] = set()
    for index in (1, 2, 3, 4):
        result = fit(full, world, index, config=config)
        full, alone = result.scene, fit(alone, world, index, config=without_patching(config)).scene
        births = set(full.free.births.tolist())
        assert len(kept - births) == result.pruned
        assert births - kept == {index * IDS_PER_FRAME + n for n in range(result.spawned)}
        kept = births
    assert world.psnr(full, 4) > world.psnr(alone, 4) + 1.0


def test_a_frame_can_be_repeated_alone() -> None:
    world = moving_world(2, emerges_at=1)
    one, two, other = (fit(world.scene, world, 1, seed=seed).scene for seed in (0, 0, 1))
    assert same(one, two)
    assert not torch.equal(one.anchors.positions, other.anchors.positions)


@pytest.mark.parametrize("field", ["offset_scales", "covariance_mlp", "anchor_positions"])
def test_a_field_outside_the_dynamic_set_stays(field: FieldName) -> None:
    world = moving_world(2)
    config = replace(without_patching(QUICK), dynamic=PAPER_DYNAMIC - {field})
    after = state_of(fit(world.scene, world, 1, config=config).scene)
    assert torch.equal(after[field], state_of(world.scene)[field])


def test_a_lifetime_of_one_frame_starts_without_free_gaussians() -> None:
    world = moving_world(3, emerges_at=1)
    config = replace(QUICK, patching=replace(QUICK.patching, lifetime="frame"))
    second = fit(fit(world.scene, world, 1, config=config).scene, world, 2, config=config)
    assert (second.scene.free.births >= 2 * IDS_PER_FRAME).all()


def test_progress_is_reported_after_every_iteration() -> None:
    steps: list[Step] = []
    world = moving_world(2)
    result = fit(world.scene, world, 1, on_step=steps.append)
    assert [step.iteration for step in steps] == list(range(1, 25))
    assert result.iterations == 24
    assert result.train_psnr > 20.0
    assert {"generate", "rasterise", "loss", "backward", "optimise"} <= set(result.seconds)


FOLLOWING = replace(QUICK, motion=varied(MotionConfig(enabled=True, picture_scale=1.0), REACH_PIXELS=1))


def followed(scene, world, index, *, config=FOLLOWING, seed=0, backend: Backend | None = None, **past):
    backend, frame = backend or quickest_backend(), world.frames[index]
    before = world.views(index - 1)
    pictures = preprocess(
        frame, world.rig, before=before, motion=config.motion, scene_flow=config.scene_flow, backend=backend
    )
    return fit_next_frame(scene, frame, world.rig, config=config, backend=backend, seed=seed, pictures=pictures, **past)


def test_only_what_moves_is_fitted_and_as_well_as_when_everything_is() -> None:
    world = moving_world(3, speed=0.06, movers=20)
    full = part = world.scene
    for index in (1, 2):
        full = fit(full, world, index, config=replace(FOLLOWING, motion=MotionConfig())).scene
        result = followed(part, world, index)
        still = (result.scene.anchors.positions == part.anchors.positions).all(1)
        assert still.sum() >= 60 - result.moving > 10
        part = result.scene
    unfitted, everything, followed_only = (world.psnr(scene, 2) for scene in (world.scene, full, part))
    assert followed_only > unfitted + 2.0
    assert followed_only > everything - 0.3


def test_what_moves_begins_where_its_last_step_leads() -> None:
    """No iteration: the fit is where it began. What stands still stays, whatever it did before."""
    world = moving_world(2, speed=0.06, movers=20)
    motion = torch.full_like(world.scene.anchors.positions, 0.01)
    before_previous = with_displacements(world.scene, -motion)
    config = replace(FOLLOWING, iterations=0, motion_prior=0.5)
    for moved in (replace(config, motion=MotionConfig()), config):
        result = followed(world.scene, world, 1, config=moved, before_previous=before_previous)
        steps = result.scene.anchors.positions - world.scene.anchors.positions
        went = (steps != 0).any(1)
        assert went.sum() == result.moving > 10
        torch.testing.assert_close(steps[went], 0.5 * motion[went])
        later = followed(world.scene, world, 1, config=moved, before_previous=before_previous, intervals=2.0)
        torch.testing.assert_close((later.scene.anchors.positions - world.scene.anchors.positions)[went], motion[went])
    alone = followed(world.scene, world, 1, config=config).scene
    assert torch.equal(alone.anchors.positions[went], world.scene.anchors.positions[went])


def test_tiles_near_change_suffice() -> None:
    """Fewer tiles are drawn, by far, and the held-out picture is as good."""
    world, drawn = moving_world(2, speed=0.06, movers=4, width=128, height=96), []

    def counting(*arguments, tiles=None, trained=None, **keywords):
        if tiles is not None and trained is not None:
            drawn[-1] += int(tiles.mask.sum())
        return quickest_backend().rasterize(*arguments, tiles=tiles, trained=trained, **keywords)

    def quality(**motion) -> float:
        drawn.append(0)
        config = replace(FOLLOWING, motion=replace(FOLLOWING.motion, **motion))
        backend = quickest_backend().with_functions(rasterize=counting)
        return world.psnr(followed(world.scene, world, 1, config=config, backend=backend).scene, 1)

    unfitted = world.psnr(world.scene, 1)
    everywhere, near, rarely = quality(), quality(tiles_around=0), quality(rest_every=3)
    assert drawn[0] > 1.2 * drawn[2] > 1.2 * drawn[1] > 0
    assert min(everywhere, near, rarely) > unfitted + 2.0
    assert min(near, rarely) > everywhere - 0.2


def test_the_mean_of_the_last_iterations_can_be_the_result() -> None:
    world = moving_world(2, speed=0.06, movers=20)
    last, mean, again = (
        followed(world.scene, world, 1, config=replace(FOLLOWING, mean_of_last=share)).scene
        for share in (0.0, 0.25, 0.25)
    )
    assert not torch.equal(last.anchors.positions, mean.anchors.positions)
    assert torch.equal(mean.anchors.positions, again.anchors.positions)
    assert world.psnr(mean, 1) > world.psnr(world.scene, 1) + 2.0


@pytest.mark.parametrize(("speed", "iterations"), [(0.16, 36), (0.06, 24)])
def test_fast_motion_takes_more_iterations(speed: float, iterations: int) -> None:
    """Fast is more than an eightieth of the width a frame."""
    world = moving_world(2, cameras=6, movers=60, speed=speed, width=128, height=96)
    config = replace(FOLLOWING, scene_flow=SceneFlowConfig(enabled=True), extra_iterations=0.5)
    result = followed(world.scene, world, 1, config=config)
    assert result.iterations == iterations


def test_the_effort_grows_with_the_share_that_moves_fast() -> None:
    config = OnlineConfig(extra_iterations=0.5)
    found = [config.effort(share) for share in (0.0, 0.015, 0.0275, 0.04, 1.0)]
    assert found == pytest.approx([1.0, 1.0, 1.25, 1.5, 1.5])
    assert OnlineConfig().effort(1.0) == 1.0  # The paper's.


def test_a_frame_like_the_last_one_costs_no_iteration_and_changes_no_bit() -> None:
    world = moving_world(2, speed=0.0)
    result = followed(world.scene, world, 1)
    assert (result.iterations, result.moving, result.spawned) == (0, 0, 0)
    assert same(result.scene, world.scene)


def test_what_all_anchors_share_stays_where_only_a_part_is_trained() -> None:
    world = moving_world(2, speed=0.06, movers=20)
    start = state_of(world.scene)["covariance_mlp"]
    assert torch.equal(state_of(followed(world.scene, world, 1, config=FOLLOWING).scene)["covariance_mlp"], start)
    assert not torch.equal(state_of(fit(world.scene, world, 1, config=QUICK).scene)["covariance_mlp"], start)
