# SPDX-License-Identifier: Apache-2.0
"""What a frame's task tells of its pictures."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from structgstream.session.pipeline import MAX_INTERVALS, FrameTask, Past
from structgstream.training.online.preprocess import FramePictures
from tests.support.backends import quickest_backend
from tests.support.worlds import moving_world

WORLD = moving_world(1, speed=0.0, movers=4, cameras=6)
TRAINING, (HELD_OUT, *_) = WORLD.rig.training, WORLD.rig.testing


def test_a_blank_training_camera_is_absent_and_a_blank_held_out_one_is_scored() -> None:
    images = dict(WORLD.frames[0].images)
    for name in (TRAINING[1], HELD_OUT):
        images[name] = np.zeros_like(images[name])
    frame, pictures = replace(WORLD.frames[0], images=images), FramePictures([], None)
    task = FrameTask(frame, pictures, WORLD.rig, lambda: torch.zeros(0, 3), quickest_backend(), seed=0)
    assert task.remarks["absent"] == (TRAINING[1],)


def test_time_goes_on_in_intervals_and_a_regular_stream_has_exactly_one() -> None:
    """0.1 + 0.2 is not 0.3: rates that are no binary fraction have unequal differences."""
    for fps in (25.0, 30.0, 29.97, 59.94):
        pasts = (Past(WORLD.scene, None, None, ((n - 2) / fps, (n - 1) / fps)) for n in range(2, 500))
        assert {past.intervals(n / fps) for n, past in enumerate(pasts, 2)} == {1.0}
    assert Past(WORLD.scene, None, None, (0.0, 0.1)).intervals(0.3) == pytest.approx(2.0)
    assert Past(WORLD.scene, None, None, (0.0, 0.2)).intervals(0.3) == pytest.approx(0.5)
    assert Past(WORLD.scene, None, None, (0.0, 0.1)).intervals(60.0) == MAX_INTERVALS
    assert Past(WORLD.scene, None).intervals(7.0) == 1.0
