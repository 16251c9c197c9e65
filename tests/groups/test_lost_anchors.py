# SPDX-License-Identifier: Apache-2.0
"""An anchor that was left behind and looks wrong is moved with its neighbours."""

from dataclasses import replace

import pytest
import torch

from structgstream.groups import first_frame
from structgstream.groups.first_frame import relocate_lost_anchors
from structgstream.scene.scene import Scene
from structgstream.training.online.config import MotionConfig, SpawnRules
from structgstream.training.online.split import DynamicSplit, find_active_tiles
from structgstream.training.views import training_views
from tests.support.backends import quickest_backend
from tests.support.worlds import moved_since, moving_world

SHIFT = 0.4
WORLD = moving_world(2, cameras=6, speed=SHIFT, width=96, height=64)
BACKEND = quickest_backend()


@pytest.fixture(autouse=True)
def of_a_small_world(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(first_frame, "NEIGHBOURS", 8)
    monkeypatch.setattr(first_frame, "FEATURE_BANDWIDTH", 5.0)


def arrived(*, but: list[int], by: float = 0.0) -> Scene:
    """The scene as it is in the second frame, with the anchors ``but`` displaced ``by`` of their way only."""
    shares = torch.ones(60, 1)
    shares[but] = by
    anchors = WORLD.scene.anchors
    shift = torch.tensor([SHIFT, 0.0, 0.0])
    return replace(WORLD.scene, anchors=replace(anchors, positions=anchors.positions + shares * shift))


def recalled(scene: Scene) -> tuple[torch.Tensor, int]:
    motion = MotionConfig(enabled=True, picture_scale=1.0)
    first, views = (training_views(WORLD.frames[t], WORLD.rig, BACKEND.device) for t in (0, 1))
    found = moved_since(scene, views, first, config=motion, backend=BACKEND)
    split = DynamicSplit.of(scene, replace(found, anchors=torch.ones(60, dtype=torch.bool)))
    moving, count = relocate_lost_anchors(
        split.dynamic,
        WORLD.scene.anchors,
        views,
        find_active_tiles(split, views, config=motion, backend=BACKEND),
        baseline=None,
        rules=SpawnRules(longer_side=96),
        backend=BACKEND,
    )
    return moving.anchors.positions, count


def seen_alone() -> int:
    """An anchor that looks wrong when it is left behind."""
    for row in range(60):
        if recalled(arrived(but=[row]))[1] == 1:
            return row
    raise AssertionError("no anchor of this world is seen by two cameras")


def test_a_straggler_goes_where_its_neighbours_went() -> None:
    row = seen_alone()
    positions, count = recalled(arrived(but=[row]))
    assert count == 1
    torch.testing.assert_close(positions, arrived(but=[]).anchors.positions, atol=1e-4, rtol=0)


def test_what_is_where_it_should_be_stays_bit_for_bit() -> None:
    everything = arrived(but=[])
    positions, count = recalled(everything)
    assert count == 0
    assert torch.equal(positions, everything.anchors.positions)


def test_what_is_a_little_off_is_left_to_the_iterations(monkeypatch: pytest.MonkeyPatch) -> None:
    row = seen_alone()
    monkeypatch.setattr(first_frame, "MIN_LOST_PIXELS", 1e3)
    positions, count = recalled(arrived(but=[row]))
    assert count == 0
    assert torch.equal(positions, arrived(but=[row]).anchors.positions)
