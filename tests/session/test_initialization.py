# SPDX-License-Identifier: Apache-2.0
"""The points from which a frame starts that has nothing before it."""

import numpy as np
import pytest
import torch

from structgstream.cameras import Similarity
from structgstream.data.points import PointsConfig
from structgstream.session import loop
from structgstream.session.loop import initial_points_of
from tests.support.memory_captures import MemoryCapture
from tests.support.worlds import moving_world

WORLD = moving_world(1, cameras=4)
SIMILARITY = Similarity((0.0, 0.1, 0.0), 2.0)


def source(points: np.ndarray | None = None) -> MemoryCapture:
    return MemoryCapture(WORLD.rig, WORLD.frames, fps=25.0, points=points)


def test_points_of_the_capture_are_taken_and_normalised(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []

    def found(source, frame, *, config, seed):
        asked.append(seed)
        return np.ones((4, 3))

    monkeypatch.setattr(loop, "frame_points", found)
    given = np.array([[0.0, 0.1, 0.0], [1.0, 0.1, -1.0]])
    options = {"config": PointsConfig(), "seed": 5, "similarity": SIMILARITY}
    points = initial_points_of(source(given), WORLD.frames[0], **options)
    torch.testing.assert_close(points.double(), torch.tensor([[0.0, 0.0, 0.0], [2.0, 0.0, -2.0]]).double())
    assert not asked
    points = initial_points_of(source(), WORLD.frames[0], **options)
    torch.testing.assert_close(points.double(), torch.tensor([[2.0, 1.8, 2.0]]).double().expand(4, 3))
    assert asked == [5]
