# SPDX-License-Identifier: Apache-2.0
"""Whole captures are opened in ``test_found_calibrations`` and ``tests/preparation/test_footage``."""

from pathlib import Path

import pytest

from structgstream.data.camera_files import other_roots, pictures_in, videos_in
from structgstream.errors import CaptureError
from tests.support.captures import picture, write_picture, write_videos


def test_videos_in_folders_of_cameras(tmp_path: Path) -> None:
    assert videos_in(tmp_path / "nowhere") == {}
    for camera in ("left", "right"):
        write_videos(tmp_path / camera, ["GX010001"], frames=2)
    assert videos_in(tmp_path) == {name: tmp_path / name / "GX010001.mp4" for name in ("left", "right")}
    write_videos(tmp_path, ["middle"], frames=2)
    assert videos_in(tmp_path) == {"middle": tmp_path / "middle.mp4"}


@pytest.mark.parametrize("inside", ["", "images/", "data/"])
def test_pictures_in_folders(tmp_path: Path, inside: str) -> None:
    write_picture(tmp_path / f"cam0/{inside}7.png", picture(0, 0))
    write_picture(tmp_path / f"masks/cam0/{inside}7.png", picture(0, 0))
    assert pictures_in(tmp_path) == {"cam0": {"7": tmp_path / f"cam0/{inside}7.png"}}


def test_one_take_is_found_and_several_are_asked_about(tmp_path: Path) -> None:
    assert list(other_roots(tmp_path)) == []
    write_videos(tmp_path / "recordings/walk", ["a", "b"], frames=2)
    assert list(other_roots(tmp_path)) == [tmp_path / "recordings/walk"]
    write_videos(tmp_path / "run", ["a", "b"], frames=2)
    with pytest.raises(CaptureError, match=r"in several folders \(run, recordings/walk\); .*Give the folder"):
        list(other_roots(tmp_path))
