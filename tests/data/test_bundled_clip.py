# SPDX-License-Identifier: Apache-2.0
"""The bundled clip as package data: its files are there, small, and say what ``cameras.json`` says."""

import json
from pathlib import Path

import av
import numpy as np
import pytest

import structgstream
from structgstream.data.dataset_layouts import bundled_clip, bundled_clip_path

# the package may be one of several folders (an editable install), so look where its data lies
CLIP = next(folder for root in structgstream.__path__ if (folder := Path(root) / "data" / "clip").is_dir())
RIG = json.loads((CLIP / "cameras.json").read_text())
CAMERAS = sorted(RIG["cameras"])


def pictures(name: str) -> tuple[np.ndarray, list[float], str]:
    """Frames ``[T, H, W, 3]``, their times in seconds and the stream's pixel format."""
    with av.open(str(CLIP / f"{name}.mp4")) as container:
        frames = list(container.decode(video=0))
    times = [float(frame.time) for frame in frames if frame.time is not None]
    return np.stack([frame.to_ndarray(format="rgb24") for frame in frames]), times, frames[0].format.name


def test_every_camera_has_one_video_and_there_are_no_others() -> None:
    assert sorted(path.stem for path in CLIP.glob("*.mp4")) == CAMERAS
    assert len(CAMERAS) == 10
    assert set(RIG["held_out"]) < set(CAMERAS)


def test_files_stay_small() -> None:
    sizes = [path.stat().st_size for path in CLIP.iterdir() if path.is_file()]
    assert sum(sizes) <= 2_500_000
    assert max(sizes) <= 400_000


@pytest.mark.parametrize("name", CAMERAS)
def test_video_has_the_stated_frames_size_and_times(name: str) -> None:
    frames, times, pixel_format = pictures(name)
    assert frames.shape == (RIG["frames"], RIG["height"], RIG["width"], 3)
    np.testing.assert_allclose(times, np.arange(RIG["frames"]) / RIG["fps"], atol=1e-4)
    assert pixel_format == "yuv444p"
    assert frames.std() > 20  # a picture, not a blank


def test_the_bundled_clip_is_a_capture() -> None:
    source = bundled_clip()
    assert (len(source.rig), len(source), source.name) == (10, 12, "clip")
    assert source.rig.testing
    frame = next(source.frames(11))
    assert frame.index == 11
    assert {image.shape for image in frame.images.values()} == {(240, 320, 3)}
    assert (bundled_clip_path() / "cameras.json").is_file()
