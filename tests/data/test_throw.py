# SPDX-License-Identifier: Apache-2.0
"""The second open capture: it opens, stays small, and moves as lab/clip/README.md says."""

from pathlib import Path

import pytest

from structgstream.data.open import open_capture
from structgstream.data.source import FrameSource

THROW = Path(__file__).parents[2] / "examples" / "throw"


@pytest.fixture(scope="module")
def capture() -> FrameSource:
    return open_capture(THROW)


def test_the_throw_is_a_capture_of_ten_cameras_and_twelve_frames(capture: FrameSource) -> None:
    assert (capture.name, len(capture.rig), len(capture)) == ("throw", 10, 12)
    assert capture.rig.testing == ("cam00",)
    assert {(camera.width, camera.height, camera.near) for camera in capture.rig.cameras.values()} == {(320, 240, 1.2)}


def test_its_files_stay_small() -> None:
    assert sorted(path.name for path in THROW.iterdir()) == [*(f"cam{n:02d}.mp4" for n in range(10)), "cameras.json"]
    assert sum(path.stat().st_size for path in THROW.iterdir()) <= 2_500_000
