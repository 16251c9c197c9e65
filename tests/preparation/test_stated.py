# SPDX-License-Identifier: Apache-2.0
"""Focal lengths that the pictures of cameras state."""

import math
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from structgstream.preparation.footage import find_footage
from structgstream.preparation.solvers import describe_focals, describe_turns, stated_focals
from tests.support.captures import write_video


def write(path: Path, film: int | None, *, orientation: int = 1) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    exif = Image.Exif()
    exif[0x0112] = orientation
    if film is not None:
        exif.get_ifd(0x8769)[0xA405] = film
    Image.new("RGB", (400, 300)).save(path, exif=exif)


def test_the_first_picture_of_each_camera_counts(tmp_path: Path) -> None:
    for name, film in {"a": 26, "b": None, "c": 52}.items():
        write(tmp_path / name / "0.jpg", film)
        write(tmp_path / name / "1.jpg", 90)
    footage = find_footage(tmp_path)
    focals = stated_focals(footage)
    one = 26 * 500 / math.hypot(36, 24)
    assert focals == {"a": pytest.approx(one), "c": pytest.approx(2 * one)}
    assert describe_focals(focals, footage) == (
        "began with the focal lengths that the pictures of 2 of 3 cameras state (0.751 to 1.502 of the longer side)"
    )
    assert "state (0.751 of the longer side)" in describe_focals({"a": one}, footage)


def test_videos_state_none(tmp_path: Path) -> None:
    for name in "ab":
        write_video(tmp_path / f"{name}.mp4", [np.zeros((48, 64, 3), np.uint8)])
    footage = find_footage(tmp_path)
    assert stated_focals(footage) == {}
    assert describe_focals({}, footage) == ""


def test_pictures_that_say_that_they_are_to_be_turned(tmp_path: Path) -> None:
    for name, orientation in {"a": 1, "b": 6, "c": 8}.items():
        write(tmp_path / f"{name}.jpg", None, orientation=orientation)
    footage = find_footage(tmp_path)
    assert describe_turns(footage).startswith("the files of ")
    assert "'b'" in describe_turns(footage)
    assert "'a'" not in describe_turns(footage)
    assert footage.size("b") == (400, 300), "as stored"
    assert describe_turns(footage.only(["a"])) == ""
