# SPDX-License-Identifier: Apache-2.0
"""Cameras that drop frames, die, or begin late, as files state it."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from structgstream.data.source import WithoutPoints
from structgstream.data.timeline import Clock
from structgstream.data.video import synchronised
from structgstream.data.video_index import scan_videos
from structgstream.preparation.checking.presence import (
    passed_frames,
    presence_findings,
    stated_presence,
    whole_frame,
)
from tests.support.captures import picture, small_rig, write_video


def test_what_files_state_without_decoding(tmp_path: Path) -> None:
    rig = small_rig(4)
    taken = {name: range(8) for name in rig} | {list(rig)[1]: [0, 1, 4, 5, 6, 7], list(rig)[2]: range(5)}
    for number, name in enumerate(rig):
        pictures = [picture(number, frame) for frame in taken[name]]
        write_video(tmp_path / f"{name}.mp4", pictures, instants=list(taken[name]))
    tracks = scan_videos({name: tmp_path / f"{name}.mp4" for name in rig})
    source = WithoutPoints(synchronised(tracks, rig, where=tmp_path))
    presence = stated_presence(source)
    for name in rig:
        np.testing.assert_array_equal(np.flatnonzero(presence[name]), list(taken[name]))
    assert whole_frame(source, presence).index == 0
    assert passed_frames(source) == {}
    first, second = presence_findings(presence, source.fps)
    assert (first.severity, first.cameras) == ("warning", (list(rig)[1],))
    assert "lacks 2 of 8 frames, the first of them frame 2 (0.07 s)" in first.sentence
    assert "ends with frame 4 (0.13 s) and is absent from the 3 frames after that" in second.sentence


def test_a_slow_clock_drops_nothing(tmp_path: Path) -> None:
    """Pictures of two cameras come later and later: some frame has none that is nearest. ``lossy`` lacks one more."""
    rig = small_rig(6)
    slow, lossy = list(rig)[4:]
    taken: dict[str, Sequence[int]] = dict.fromkeys(rig, range(110))
    taken[lossy] = [frame for frame in range(110) if frame != 8]
    for number, name in enumerate(rig):
        pictures = [picture(number, frame) for frame in taken[name]]
        write_video(tmp_path / f"{name}.mp4", pictures, instants=list(taken[name]))
    tracks = scan_videos({name: tmp_path / f"{name}.mp4" for name in rig})
    clocks = {name: Clock(rate=1.01) if name in (slow, lossy) else Clock() for name in rig}
    source = synchronised(tracks, rig, where=tmp_path, clocks=clocks)
    presence, passed = stated_presence(source), passed_frames(source)
    (at,) = passed[slow]
    assert 20 < at < 90
    assert {name: list(frames) for name, frames in passed.items()} == {slow: [at], lossy: [at]}
    reported, dropped = presence_findings(presence, source.fps, passed=passed)
    assert (reported.severity, reported.cameras) == ("note", (slow, lossy))
    assert f"{slow!r} 1, the first at {at / source.fps:.2f} s" in reported.sentence
    assert (dropped.severity, dropped.cameras) == ("warning", (lossy,))
    assert "lacks 1 of" in dropped.sentence


@pytest.mark.parametrize("present", [[True] * 3, [False] * 3])
def test_all_and_nothing(present: list[bool]) -> None:
    found = presence_findings({"a": np.array(present)}, 30.0)
    assert [finding.sentence for finding in found] == (
        [] if all(present) else [
            "Camera 'a' has no picture of any frame that can be read; leave it out, or restore its files."
        ]
    )  # fmt: skip


def test_cameras_that_are_stopped_by_hand_are_reported_once() -> None:
    """Three of four end 2 to 14 frames of 300 early; one ends 30 early, which costs a second."""
    presence = {name: np.arange(300) < end for name, end in (("a", 300), ("b", 298), ("c", 286), ("d", 270))}
    note, warning = presence_findings(presence, 30.0)
    assert (note.severity, note.cameras) == ("note", ("b", "c"))
    assert "end up to 0.47 s before the last camera" in note.sentence
    assert "up to frame 285 (9.50 s)" in note.sentence
    assert (warning.severity, warning.cameras) == ("warning", ("d",))
    assert "ends with frame 269" in warning.sentence


def test_what_is_dropped_is_reported_a_camera_that_ends_a_little_early() -> None:
    present = np.arange(300) < 295
    present[100:103] = False
    note, warning = presence_findings({"a": np.ones(300, bool), "b": present}, 30.0)
    assert note.severity == "note"
    assert "lacks 3 of 295 frames" in warning.sentence
    assert "ends with" not in warning.sentence


def test_of_many_cameras_that_drop_frames_one_warning_tells_and_says_with_which_frame_to_begin() -> None:
    presence = {name: np.ones(20, bool) for name in "abcd"}
    presence["a"][[0, 7]] = presence["b"][1] = presence["c"][[2, 9, 12]] = False
    dropped, start = presence_findings(presence, 30.0)
    assert (dropped.severity, dropped.cameras) == ("warning", ("c", "a", "b"))
    assert "3 cameras lack some of 20 frames ('c' 3, 'a' 2, 'b' 1)" in dropped.sentence
    assert (start.severity, start.cameras) == ("warning", ("a",))
    assert "Camera 'a' has no picture of frame 0" in start.sentence
    assert "begin with frame 3 (--start), which 4 of 4 cameras have" in start.sentence


def test_where_no_frame_has_all_cameras_one_with_most_is_advised() -> None:
    presence = {"a": np.array([False, False, False, True]), "b": np.array([True, True, True, False])}
    presence |= {"c": np.array([False, True, True, True])}
    *_, start = presence_findings(presence, 30.0)
    assert start.cameras == ("a", "c")
    assert "begin with frame 1 (--start), which 2 of 3 cameras have" in start.sentence
