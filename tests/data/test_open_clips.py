# SPDX-License-Identifier: Apache-2.0
"""The two open captures, of which one is package data: their files are there, small, and as ``cameras.json`` says."""

import json
from pathlib import Path

import av
import numpy as np
import pytest

import structgstream
from structgstream.data.dataset_layouts import bundled_clip, bundled_clip_path
from structgstream.data.open import open_capture

# the package may be one of several folders (an editable install), so look where its data lies
CLIP = next(folder for root in structgstream.__path__ if (folder := Path(root) / "data" / "clip").is_dir())
THROW = Path(__file__).parents[2] / "examples" / "throw"
CAMERAS = [f"cam{number:02d}" for number in range(10)]

of_both = pytest.mark.parametrize("folder", [CLIP, THROW], ids=lambda folder: folder.name)


@of_both
def test_every_camera_has_one_video_and_files_stay_small(folder: Path) -> None:
    assert sorted(path.stem for path in folder.glob("*.mp4")) == CAMERAS
    sizes = [path.stat().st_size for path in folder.iterdir() if path.is_file()]
    assert sum(sizes) <= 2_500_000
    assert max(sizes) <= 400_000


@of_both
def test_videos_have_the_stated_frames_size_and_times(folder: Path) -> None:
    rig = json.loads((folder / "cameras.json").read_text())
    for name in CAMERAS:
        with av.open(str(folder / f"{name}.mp4")) as container:
            frames = list(container.decode(video=0))
        pictures = np.stack([frame.to_ndarray(format="rgb24") for frame in frames])
        assert pictures.shape == (rig["frames"], rig["height"], rig["width"], 3)
        times = [float(frame.time) for frame in frames if frame.time is not None]
        np.testing.assert_allclose(times, np.arange(rig["frames"]) / rig["fps"], atol=1e-4)
        assert frames[0].format.name == "yuv444p"
        assert pictures.std() > 20  # a picture, not a blank


@of_both
def test_they_are_captures(folder: Path) -> None:
    source = open_capture(folder)
    assert (source.name, [*source.rig], len(source)) == (folder.name, CAMERAS, 12)
    assert len(source.rig.testing) == 1
    frame = next(source.frames(11))
    assert frame.index == 11
    assert {image.shape for image in frame.images.values()} == {(240, 320, 3)}


def test_the_bundled_one_is_found() -> None:
    assert (bundled_clip_path() / "cameras.json").is_file()
    assert (bundled_clip().name, len(bundled_clip().rig)) == ("clip", 10)
