# SPDX-License-Identifier: Apache-2.0
"""A far frame is fitted from frame 0 and tracked positions, in a world whose motion is known."""

from dataclasses import replace

import pytest
import torch

from structgstream.groups import first_frame
from structgstream.groups.first_frame import GroupStartConfig, fit_group_start
from structgstream.training.online.config import (
    MotionConfig,
    OnlineConfig,
    OnlineRates,
    PatchingConfig,
    SceneFlowConfig,
    SmoothnessConfig,
    SpawnConfig,
    SpawnRules,
)
from structgstream.training.online.patching import IDS_PER_FRAME
from structgstream.training.online.preprocess import detect_changes
from structgstream.training.parameters import RoundingConfig
from structgstream.training.residuals import baseline_residual
from tests.support.backends import quickest_backend
from tests.support.streams import same
from tests.support.varied import varied
from tests.support.worlds import World, moving_world

SPEED, FRAME = 0.06, 4
MOTION = MotionConfig(enabled=True, picture_scale=0.5, residual_threshold=0.05)
CONFIG = OnlineConfig(
    rates=varied(OnlineRates(), ANCHOR_POSITIONS=1e-3),
    motion=MOTION,
    scene_flow=SceneFlowConfig(enabled=True),
    spawn=varied(SpawnConfig(enabled=True), RULES=SpawnRules(longer_side=128)),
    patching=PatchingConfig(spawn="off", iteration=4),
)
START = GroupStartConfig(iterations=16, rounds=2, births=40)
STEPS = {"anchor_positions": 0.004}


def scenery(*, movers: int = 60, emerges_at: int | None = None) -> World:
    made = moving_world(FRAME + 1, cameras=6, movers=movers, speed=SPEED, width=128, height=96, emerges_at=emerges_at)
    step, anchors = STEPS["anchor_positions"], made.scene.anchors
    on_grid = replace(anchors, positions=(anchors.positions / step).round() * step)  # As a decoded frame 0 is.
    return replace(made, scene=replace(made.scene, anchors=on_grid))


def fit(world: World, displacements: torch.Tensor, *, start: GroupStartConfig = START, config: OnlineConfig = CONFIG):
    backend = quickest_backend()
    first, views = (world.views(t) for t in (0, FRAME))
    return fit_group_start(
        world.scene,
        displacements,
        views,
        detect_changes(views, first, config=config.motion, backend=backend),
        frame_index=FRAME,
        config=config,
        start=start,
        backend=backend,
        seed=1,
        steps=STEPS,
        baseline=baseline_residual(world.scene, first, scale=config.motion.picture_scale, backend=backend),
    )


def truth(world: World, movers: int = 60) -> torch.Tensor:
    shift = torch.zeros(len(world.scene.anchors) + len(world.scene.free), 3)
    shift[:movers, 0] = FRAME * SPEED
    return shift


def test_tracked_positions_and_two_rounds_reach_the_far_frame() -> None:
    world = scenery()
    rough = truth(world) * 0.85
    tracked = fit(world, rough)
    jumped = fit(world, torch.zeros_like(rough))
    assert world.psnr(tracked.scene, FRAME) > world.psnr(jumped.scene, FRAME) + 2
    assert tracked.iterations == 16
    assert tracked.counts["corrected"] > 0


def test_it_has_the_iterations_of_eleven_online_frames_unless_asked() -> None:
    world = scenery(movers=20)
    config = replace(CONFIG, iterations=3)
    usual = replace(START, iterations=None, rounds=3)
    assert fit(world, truth(world, 20), start=usual, config=config).iterations == 33


def test_what_does_not_change_keeps_the_bits_of_frame_0() -> None:
    world = scenery(movers=0)
    assert same(fit(world, truth(world, 0)).scene, world.scene)


def test_changes_are_priced_against_frame_0() -> None:
    """With a price that forbids everything, anchors return to frame 0 although they begin elsewhere."""
    world = scenery(movers=20)
    dear = replace(CONFIG, rounding=RoundingConfig(rate_weight=50.0))
    away = truth(world, 20) * 0.02  # Few bins.
    cheap, paid = (fit(world, away, config=config).scene.anchors.positions for config in (CONFIG, dear))
    first = world.scene.anchors.positions
    assert (paid - first).abs().mean() < (cheap - first).abs().mean()


def test_motion_is_coherent_since_frame_0_and_not_since_the_round_began() -> None:
    world = scenery()
    noisy = truth(world)
    noisy[:60] += 0.01 * torch.randn(60, 3, generator=torch.Generator().manual_seed(3))

    def spread(weight: float) -> float:
        found = fit(world, noisy, config=replace(CONFIG, smoothness=SmoothnessConfig(weight)))
        return float((found.scene.anchors.positions - world.scene.anchors.positions)[:60].std(0).norm())

    assert spread(4.0) < 0.8 * spread(0.0)


def test_births_of_several_rounds_have_identities_of_their_own(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(first_frame, "flow_views", lambda *_: ())
    world = moving_world(FRAME + 1, cameras=6, emerges_at=1, movers=0, width=96, height=64)
    none = torch.zeros(len(world.scene.anchors) + len(world.scene.free), 3)
    motion = MotionConfig(enabled=True, picture_scale=1.0)
    config = replace(CONFIG, motion=motion, spawn=varied(SpawnConfig(enabled=True), RULES=SpawnRules(min_hits=2)))
    found = fit(world, none, config=config)
    births = found.scene.free.births
    assert len(births) > 0
    assert len(births.unique()) == len(births)
    assert (births // IDS_PER_FRAME == FRAME).all()
