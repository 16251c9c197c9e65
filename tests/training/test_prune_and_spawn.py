# SPDX-License-Identifier: Apache-2.0
"""Before the first iteration: Gaussians are spawned where something emerged, and those with the error are pruned."""

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch

from structgstream.kernels.backend import Backend
from structgstream.scene.free import FreeGaussians
from structgstream.scene.scene import Scene
from structgstream.training.online.config import MotionConfig, SpawnConfig, SpawnRules, ThinSpawnConfig
from structgstream.training.online.patching import IDS_PER_FRAME
from structgstream.training.online.spawn import SpawnResult, Sweep, prune_and_spawn
from structgstream.training.online.split import DynamicSplit, find_active_tiles
from structgstream.training.residuals import BaselineResidual, baseline_residual
from tests.support.backends import on_each_backend, quickest_backend
from tests.support.varied import varied
from tests.support.worlds import emerging_ball, moved_since, moving_world

BACKEND = quickest_backend()
WORLD = moving_world(2, cameras=6, emerges_at=1, movers=0, width=96, height=64)
CONFIG = varied(SpawnConfig(enabled=True), RULES=SpawnRules(min_hits=2, planes=96))  # so small a ball needs more depths


def renewed(
    *,
    backend: Backend = BACKEND,
    scene: Scene = WORLD.scene,
    config: SpawnConfig = CONFIG,
    room: int = 1000,
    baseline: BaselineResidual | None = None,
    residual_threshold: float = 0.0,
) -> SpawnResult:
    motion = MotionConfig(enabled=True, picture_scale=1.0, residual_threshold=residual_threshold)
    first, views = (WORLD.views(t) for t in (0, 1))
    baseline = baseline_residual(WORLD.scene, first, scale=1.0, backend=backend) if baseline is None else baseline
    split = DynamicSplit.of(scene, moved_since(scene, views, first, config=motion, backend=backend, baseline=baseline))
    return prune_and_spawn(
        split,
        views,
        find_active_tiles(split, views, config=motion, backend=backend),
        first_identity=1 << 32,
        baseline=baseline,
        room=room,
        config=config,
        backend=backend,
    )


@on_each_backend
def test_an_emerging_ball_is_spawned_where_it_is(build: Callable[[], Backend]) -> None:
    found, ball = renewed(backend=build()), emerging_ball(0.95)
    spawned = found.new_free
    assert len(spawned) >= 3
    assert not found.refused
    near = (spawned.means - ball.means).norm(dim=1)
    assert near.median() < 2.5 * float(ball.scales[0, 0])
    torch.testing.assert_close(spawned.colors.median(0).values, ball.colors[0], atol=0.4, rtol=0)  # soft, before others
    assert spawned.births.tolist() == [IDS_PER_FRAME + n for n in range(len(spawned))]
    torch.testing.assert_close(spawned.logit_opacities.sigmoid(), torch.full((len(spawned),), 0.7))


def test_what_emerges_before_something_that_frame_0_drew_badly_is_spawned_if_the_baseline_is_capped() -> None:
    baseline = baseline_residual(WORLD.scene, WORLD.views(), scale=1.0, backend=BACKEND)
    bad = replace(baseline, maps={i: torch.full_like(of_view, 0.02) for i, of_view in baseline.maps.items()})
    for of_view in bad.maps.values():
        of_view[16:48, 24:72] = 0.9  # Frame 0 was drawn badly in the middle, where the ball is now.
    spawned = [
        len(renewed(baseline=bad, config=varied(CONFIG, BASELINE_CAP_MEDIANS=medians)).new_free)
        for medians in (1e9, 1.0)
    ]
    assert spawned[0] == 0
    assert spawned[1] >= 3


def test_where_no_picture_lacks_anything_nothing_is_drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn, draw = list[str](), Sweep._draw

    def counting(*arguments, **options):
        drawn.append("once")
        return draw(*arguments, **options)

    monkeypatch.setattr(Sweep, "_draw", counting)
    assert not len(renewed(config=replace(CONFIG, missing_threshold=10.0)).new_free)
    assert not drawn
    assert len(renewed().new_free)
    assert drawn, "where something is missing it is"


def test_spawning_keeps_to_the_room_there_is() -> None:
    everything = renewed()
    few = renewed(config=replace(CONFIG, most=2))
    assert len(few.new_free) == 2
    assert float(few.new_free.log_scales.min()) > float(everything.new_free.log_scales.max()), "they are coarser"
    assert few.counts["merged"] == len(everything.new_free) - 2, "which the log reports"
    assert len(renewed(room=1).new_free) == 1
    assert len(renewed(room=0).new_free) == 0
    assert len(everything.new_free) > 2


def test_off_nothing_is_spawned() -> None:
    found = renewed(config=replace(CONFIG, enabled=False))
    assert len(found.new_free) == 0
    assert found.kept.all()


def test_when_everything_is_missing_nothing_is_spawned_and_that_is_reported() -> None:
    found = renewed(config=varied(CONFIG, RULES=replace(CONFIG.RULES, max_missing_share=1e-4)))
    assert found.refused
    assert len(found.new_free) == 0


def test_a_ghost_dies() -> None:
    """The ball was there in a wrong place before: nobody sees it there now."""
    ghost = emerging_ball(0.95)
    look = ghost.scales.log(), ghost.colors
    places = ghost.means + torch.tensor([[0.5, 0.0, 0.0]])
    free = FreeGaussians.spawned(places, *look, opacity=0.95, first_identity=3)
    found = renewed(scene=replace(WORLD.scene, free=free), residual_threshold=0.05)
    assert found.kept.tolist() == [False], "what is wrong is dynamic"


BLIND = replace(CONFIG, missing_threshold=0.9)
"""By these rules nothing is missing; thin content needs nine times as much as its rules say."""
THIN = varied(
    ThinSpawnConfig(enabled=True),
    RULES=replace(
        ThinSpawnConfig.RULES,
        longer_side=96,
        missing_threshold=0.10 / 9,
        max_contradictions=0.34,
        max_cost=0.12,
        min_hits=2,
    ),
)


def test_what_the_first_sweep_does_not_see_the_second_one_bears() -> None:
    assert not len(renewed(config=BLIND).new_free)
    found = renewed(config=replace(BLIND, thin=THIN))
    assert found.thin_count == len(found.new_free) > 0
    ball = emerging_ball(0.95)
    near = (found.new_free.means - ball.means).norm(dim=1)
    assert int((near < ball.scales[0, 0]).sum()) >= 2, "within the ball"


def test_the_second_sweep_is_left_out_where_the_first_one_bears() -> None:
    alone, both = (renewed(config=config) for config in (CONFIG, replace(CONFIG, thin=THIN)))
    assert torch.equal(alone.new_free.means, both.new_free.means)
    assert both.thin_count == 0


def test_the_second_sweep_bears_nothing_where_it_would_bear_more_than_thin_content() -> None:
    """In a throw everything that lags would be spawned, and stand where anchors belong."""
    number = len(renewed(config=replace(BLIND, thin=THIN)).new_free)
    for most, spawned in ((number, number), (number - 1, 0)):
        found = renewed(config=replace(BLIND, thin=varied(THIN, RULES=replace(THIN.RULES, most=most))))
        assert len(found.new_free) == found.thin_count == spawned
        assert found.counts["refused thin"] == number - spawned, "counted in the log"


def test_the_second_sweep_bears_nothing_where_much_is_missing() -> None:
    few = varied(THIN, RULES=replace(THIN.RULES, max_missing_share=1e-4))
    assert not len(renewed(config=replace(BLIND, thin=few)).new_free)
