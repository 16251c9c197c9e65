# SPDX-License-Identifier: Apache-2.0
"""Pictures of a capture on demand: which, how many are kept, and what a broken video does."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from structgstream.data.dataset_layouts import bundled_clip_path
from structgstream.data.open import open_capture
from structgstream.data.source import FrameSource
from structgstream.errors import CaptureError
from structgstream.serve.play import Truth
from tests.support.memory_captures import MemoryCapture
from tests.support.pictures import decoded_picture


@pytest.fixture(scope="module")
def source() -> FrameSource:
    return open_capture(bundled_clip_path(), scale=0.5)


@pytest.fixture(scope="module")
def taken(source: FrameSource) -> dict[tuple[str, int], NDArray[np.uint8]]:
    frames = list(source.frames())
    return {(name, frame.index): frame.images[name] for frame in frames for name in ("cam00", "cam04")}


def test_any_order_gives_the_camera_and_frame_that_was_asked_for(
    source: FrameSource, taken: dict[tuple[str, int], NDArray[np.uint8]]
) -> None:
    truth = Truth(source, ("cam00", "cam04"))
    for camera, frame in [("cam00", 0), ("cam00", 1), ("cam00", 5), ("cam00", 4), ("cam04", 5), ("cam04", 0)]:
        picture = decoded_picture(truth.jpeg(camera, frame) or b"").astype(int)
        errors = {at: float(np.abs(picture - other).mean()) for at, other in taken.items()}
        assert min(errors, key=errors.__getitem__) == (camera, frame)
        assert errors[camera, frame] < 3


def test_what_was_asked_for_is_not_decoded_again(source: FrameSource) -> None:
    truth = Truth(source, ("cam00",))
    assert truth.jpeg("cam00", 3) is truth.jpeg("cam00", 3)


def test_nobody_and_never(source: FrameSource) -> None:
    truth = Truth(source, ("cam00",))
    assert [truth.jpeg(camera, frame) for camera, frame in [("cam01", 0), ("cam00", 12), ("cam00", -1)]] == [None] * 3


def test_a_video_that_breaks_is_reported_and_asked_again(tmp_path: Path) -> None:
    folder = tmp_path / "clip"
    shutil.copytree(bundled_clip_path(), folder)
    truth = Truth(open_capture(folder), ("cam00",))
    assert truth.jpeg("cam00", 0)
    video = folder / "cam00.mp4"
    whole = video.read_bytes()
    video.unlink()
    with pytest.raises(CaptureError, match=r"cam00\.mp4"):
        truth.jpeg("cam00", 10)
    video.write_bytes(whole)
    assert truth.jpeg("cam00", 10)


def test_a_camera_that_is_absent_from_a_frame_has_no_picture_there(
    tmp_path: Path, source: FrameSource, taken: dict[tuple[str, int], NDArray[np.uint8]]
) -> None:
    frames = [
        replace(
            frame, images={name: image for name, image in frame.images.items() if (name, frame.index) != ("cam00", 1)}
        )
        for frame in source.frames()
    ]
    truth = Truth(MemoryCapture(source.rig, frames), ("cam00", "cam04"))
    assert [truth.jpeg("cam00", frame) is None for frame in range(3)] == [False, True, False]
    assert truth.jpeg("cam04", 1) is not None
