# SPDX-License-Identifier: Apache-2.0
"""Calls of the solvers: which clocks, which pictures, and what is said when there are none."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from structgstream.data.timeline import Clock
from structgstream.errors import CalibrationError, CaptureError
from structgstream.preparation.footage import Footage, find_footage
from structgstream.preparation.options import PrepareOptions
from structgstream.preparation.solvers import (
    TIMESTAMPS,
    board_footage,
    describe_focals,
    describe_turns,
    first_clocks,
    stated_focals,
    synchronized,
)
from tests.support.captures import write_video

NAMES = ("a", "b", "c")


def picture(value: int, size: tuple[int, int] = (64, 48)) -> np.ndarray:
    return np.full((size[1], size[0], 3), value, np.uint8)


def filmed(
    folder: Path, *, frames: int = 12, size: tuple[int, int] = (64, 48), names: tuple[str, ...] = NAMES
) -> Footage:
    """Videos at 30 frames a second whose brightness rises by 10 a frame, by 1 a camera."""
    for index, name in enumerate(names):
        write_video(folder / f"{name}.mp4", [picture(20 + 10 * i + index, size) for i in range(frames)])
    return find_footage(folder)


def table(footage: Footage, late: dict[str, float]) -> None:
    """``timestamps.csv`` of cameras that are late."""
    lines = ["camera,frame,seconds"]
    for name in footage.cameras:
        lines += [f"{name},{i},{i / 30 + late.get(name, 0.0):.6f}" for i in range(len(footage.stamps(name)))]
    (footage.where / TIMESTAMPS).write_text("\n".join(lines) + "\n")


@pytest.mark.parametrize(("videos", "beside"), [("", ""), ("videos", ""), ("videos", "videos")])
def test_a_table_of_times_is_taken_by_itself(tmp_path: Path, videos: str, beside: str) -> None:
    filmed(tmp_path / videos)
    footage = find_footage(tmp_path)
    table(footage, {"b": 0.1})
    (tmp_path / TIMESTAMPS).replace(tmp_path / beside / TIMESTAMPS)
    found = synchronized(footage, PrepareOptions())
    assert (found.method, found.sure) == ("csv", True)
    starts = {name: clock.offset_seconds for name, clock in found.clocks.items()}
    assert starts["b"] - starts["a"] == pytest.approx(0.1, abs=1e-4)
    assert starts["c"] - starts["a"] == pytest.approx(0.0, abs=1e-4)


def test_single_pictures_have_no_clocks(tmp_path: Path) -> None:
    footage = filmed(tmp_path, frames=1)
    assert synchronized(footage, PrepareOptions(synchronize="audio")).method == "none"


def test_who_asked_for_nothing_is_reported_none(tmp_path: Path) -> None:
    footage = filmed(tmp_path)
    with pytest.raises(CaptureError, match="--synchronize none") as asked:
        synchronized(footage, PrepareOptions())
    with pytest.raises(CaptureError) as named:
        synchronized(footage, PrepareOptions(synchronize="audio"))
    assert "Cameras that one signal starts" in str(asked.value)
    assert "Cameras that one signal starts" not in str(named.value)


def test_before_a_calibration_motion_may_fail_and_nothing_else(tmp_path: Path) -> None:
    footage = filmed(tmp_path)
    for how in ("auto", "motion"):
        found = first_clocks(footage, PrepareOptions(synchronize=how))
        assert (found.method, found.sure, dict(found.clocks)) == ("motion", False, dict.fromkeys(NAMES, Clock()))
        assert found.summary.startswith("motion: not without the calibration. ")
    with pytest.raises(CaptureError):
        first_clocks(footage, PrepareOptions(synchronize="audio"))
    (tmp_path / TIMESTAMPS).write_text("a,b\n")
    with pytest.raises(CaptureError, match="timestamps.csv"):
        first_clocks(footage, PrepareOptions())


def test_videos_without_a_moment_in_common(tmp_path: Path) -> None:
    footage = filmed(tmp_path)
    table(footage, {"b": 9.0})
    with pytest.raises(CaptureError, match="no instant in common"):
        synchronized(footage, PrepareOptions())


def test_the_board_is_filmed_by_all_in_the_same_mode(tmp_path: Path) -> None:
    footage = filmed(tmp_path / "take")
    filmed(tmp_path / "board", frames=3, names=(*NAMES, "d"))
    options = PrepareOptions(board_videos=tmp_path / "board")
    assert board_footage(footage, options).cameras == NAMES
    (tmp_path / "board" / "b.mp4").unlink()
    with pytest.raises(CaptureError, match="board has no video of camera 'b' of .*take; film the board with it too"):
        board_footage(footage, options)
    filmed(tmp_path / "board", frames=3, names=("b",), size=(48, 64))
    with pytest.raises(CalibrationError, match="'b' filmed the board with 48x64 pixels .* and the take with 64x48"):
        board_footage(footage, options)
    assert board_footage(footage.only(("a", "c")), replace(options, fps=25)).cameras == ("a", "c")


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
