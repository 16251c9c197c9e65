# SPDX-License-Identifier: Apache-2.0
"""What moves begins a frame where the pictures show it."""

import torch

from structgstream.training.online.config import MotionConfig, SceneFlowConfig
from structgstream.training.online.preprocess import flow_views
from structgstream.training.online.scene_flow import apply_scene_flow
from structgstream.training.online.split import DynamicSplit
from tests.support.backends import quickest_backend
from tests.support.worlds import World, moved_since, moving_world

BACKEND = quickest_backend()
MOTION = MotionConfig(enabled=True, picture_scale=0.5)
SPEED = 0.08  # 2.1 pixels of the pictures below


def world(*, speed: float = SPEED) -> World:
    return moving_world(2, cameras=6, movers=60, speed=speed, width=128, height=96)


def begun(scenery: World, *, rounds: int = 2, enabled: bool = True):
    config = SceneFlowConfig(enabled=enabled, rounds=rounds)
    views, before = (scenery.views(t) for t in (1, 0))
    selection = moved_since(scenery.scene, views, before, config=MOTION, flow_from=flow_views(views, 1, config))
    split = DynamicSplit.of(scenery.scene, selection)
    priors = torch.zeros(len(selection.primitives), 3)
    return split, apply_scene_flow(split, views, priors, config=config, motion=MOTION, backend=BACKEND)


def test_anchors_begin_near_where_they_have_gone() -> None:
    split, start = begun(world())
    assert start.counts["displaced"] > 0.5 * len(start.displacements)
    moved = start.displacements.median(0).values
    assert abs(float(moved[0]) - SPEED) < 0.35 * SPEED
    assert moved[1:].abs().max() < 0.35 * SPEED
    assert start.active_tiles, "it shows somewhere"
    assert len(start.displacements) == len(split.dynamic.anchors)


def test_fast_movers_are_counted_and_how_many_of_them_flow_displaces() -> None:
    """Fast is more than an eightieth of the width: here 1.6 pixels."""
    _, found = begun(world(speed=2 * SPEED))
    displaced, _, fast, fast_displaced = found.counts.values()
    assert 0.5 * len(found.displacements) < fast <= len(found.displacements)
    assert 0.8 * fast < fast_displaced <= min(fast, displaced)
    _, slow = begun(world(speed=0.5 * SPEED))
    assert slow.counts["fast"] == slow.counts["fast displaced"] == 0


def test_the_second_round_acts_where_much_moves_fast() -> None:
    once, twice = (begun(world(speed=2 * SPEED), rounds=rounds)[1] for rounds in (1, 2))
    assert once.counts["corrected"] == 0
    assert twice.counts["corrected"] > 0
    assert not torch.equal(once.displacements, twice.displacements)
    assert begun(world())[1].counts["corrected"] == 0, "nothing moves fast"


def test_off_everything_begins_where_its_prior_says() -> None:
    _, start = begun(world(), enabled=False)
    assert not start.displacements.any()
    assert start.counts == {"displaced": 0, "corrected": 0, "fast": 0, "fast displaced": 0}
    assert start.active_tiles


def test_flow_is_looked_for_in_turns_where_there_are_many_views() -> None:
    views = world().views()  # five
    config = SceneFlowConfig(enabled=True, views=3)
    turns = [flow_views(views, frame, config) for frame in (1, 2)]
    assert [len(turn) for turn in turns] == [2, 3]
    assert turns[0] | turns[1] == {view.index for view in views}
    assert flow_views(views, 3, config) == turns[0]
    assert len(flow_views(views, 1, SceneFlowConfig(enabled=True))) == 5
    assert not flow_views(views, 1, SceneFlowConfig())
