# SPDX-License-Identifier: Apache-2.0
"""The second open capture: it opens, stays small, and moves as lab/clip/README.md says."""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch

from structgstream.cameras import Camera
from structgstream.data.open import open_capture
from structgstream.data.source import FrameSource

THROW = Path(__file__).parents[2] / "examples" / "throw"
# metres, as lab/clip/README.md states them: thrown, in flight, on the floor, at the second figure's hands
BALL_CENTRES = {
    2: (0.427, -0.232, 1.218),
    5: (0.175, -0.442, 0.718),
    8: (-0.078, -0.651, 0.120),
    11: (-0.330, -0.860, 0.589),
}
BALL_RADIUS = 0.12
ENTRY_COLUMNS = 40


@pytest.fixture(scope="module")
def capture() -> FrameSource:
    return open_capture(THROW)


@pytest.fixture(scope="module")
def pictures(capture: FrameSource) -> dict[str, np.ndarray]:
    """``[T, H, W, 3]`` of each camera."""
    frames = list(capture.frames())
    return {name: np.stack([frame.images[name] for frame in frames]) for name in capture.rig}


def projected(camera: Camera, point: tuple[float, float, float]) -> tuple[float, float, float]:
    """Pixel and depth of a point in metres."""
    seen = camera.viewmat[:3, :3] @ torch.tensor(point, dtype=torch.float64) + camera.viewmat[:3, 3]
    x, y, depth = (camera.K @ seen).tolist()
    return x / depth, y / depth, depth


def test_the_throw_is_a_capture_of_ten_cameras_and_twelve_frames(capture: FrameSource) -> None:
    assert (capture.name, len(capture.rig), len(capture)) == ("throw", 10, 12)
    assert capture.rig.testing == ("cam00",)
    assert {(camera.width, camera.height, camera.near) for camera in capture.rig.cameras.values()} == {(320, 240, 1.2)}


def test_its_files_stay_small() -> None:
    assert sorted(path.name for path in THROW.iterdir()) == [*(f"cam{n:02d}.mp4" for n in range(10)), "cameras.json"]
    assert sum(path.stat().st_size for path in THROW.iterdir()) <= 2_500_000


@pytest.mark.parametrize("frame", BALL_CENTRES)
def test_every_camera_sees_the_ball_where_it_was_thrown(
    capture: FrameSource, pictures: dict[str, np.ndarray], frame: int
) -> None:
    for name, camera in capture.rig.cameras.items():
        x, y, depth = projected(camera, BALL_CENTRES[frame])
        reach = float(camera.K[0, 0]) * BALL_RADIUS / depth / 2  # half the ball: inside its rim
        rows, columns = np.mgrid[0:240, 0:320] + 0.5
        inside = np.hypot(columns - x, rows - y) < reach
        red, green, blue = np.median(pictures[name][frame][inside], axis=0)
        assert red > green + 40 > blue + 40, (name, frame, red, green, blue)


def test_the_ball_steps_many_pixels_a_frame(capture: FrameSource) -> None:
    for camera in capture.rig.cameras.values():
        points = [projected(camera, BALL_CENTRES[frame]) for frame in (2, 5, 8)]
        steps = [np.hypot(b[0] - a[0], b[1] - a[1]) / 3 for a, b in pairwise(points)]
        assert min(steps) > 15
        assert max(steps) < 26


def test_a_figure_enters_through_the_left_border(pictures: dict[str, np.ndarray]) -> None:
    strip = pictures["cam00"][:, 80:, :ENTRY_COLUMNS].astype(int)
    changed = (np.abs(strip - strip[0]).max(axis=-1) > 40).mean(axis=(1, 2))
    assert changed[:4].max() < 0.01
    assert 0.1 < changed[5] < changed[6] < changed[7] < changed[9]
    assert changed[11] < changed[10] < changed[9]  # it has passed the border


def test_much_changes_from_frame_to_frame_and_much_stays(pictures: dict[str, np.ndarray]) -> None:
    for name, frames in pictures.items():
        changed = np.abs(frames[1:].astype(int) - frames[:-1]).max(axis=-1) > 25
        assert (changed.mean(axis=(1, 2)) > 0.01).all(), name
        assert changed.any(axis=0).mean() < 0.7, name
