# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

from structgstream.kernels.backend import reference_backend
from structgstream.training.online.config import MotionConfig, SceneFlowConfig
from structgstream.training.online.preprocess import FramePictures, preprocess
from tests.support.worlds import moving_world

WORLD = moving_world(2, cameras=6, movers=60, speed=0.08, width=128, height=96)
MOTION = MotionConfig(enabled=True, picture_scale=0.5)


def pictures(*, motion: MotionConfig = MOTION, first: bool = False) -> FramePictures:
    backend, scene_flow = reference_backend(), SceneFlowConfig(enabled=True, views=3)
    before = None if first else WORLD.views()
    return preprocess(WORLD.frames[1], WORLD.rig, before=before, motion=motion, scene_flow=scene_flow, backend=backend)


def test_what_moves_changes_and_flow_is_looked_for_in_some_views() -> None:
    found = pictures()
    assert found.changes is not None
    changes = [change for change in found.changes if change is not None]
    assert len(changes) == len(found.views) == len(WORLD.rig.training)
    assert 2 <= sum(change.flow is not None for change in changes) <= 3
    for view, change in zip(found.views, changes):
        assert change.changed.shape == view.image.shape[:2]
        assert 0.0 < float(change.changed.float().mean()) < 0.9
        assert not change.repeated
        if change.flow is not None:
            assert change.flow.shape == (48, 64, 6)
            confidence, shift = change.flow[..., 0], change.flow[..., 1:3]
            assert confidence.max() > 0.5
            assert shift.abs().max() > 0.5


def test_everything_may_move_without_a_frame_before_without_a_gate_and_in_full_frames() -> None:
    assert pictures(first=True).changes is None
    assert pictures(motion=replace(MOTION, enabled=False)).changes is None
