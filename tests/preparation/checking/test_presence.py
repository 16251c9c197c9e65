# SPDX-License-Identifier: Apache-2.0
"""Cameras that drop frames, die, or begin late, as files state it."""

from pathlib import Path

import numpy as np
import pytest

from captures import picture, small_rig, write_video
from structgstream.data.video import synchronised
from structgstream.data.video_index import scan_videos
from structgstream.data.wrappers import WithoutPoints
from structgstream.preparation.checking.presence import presence_findings, stated_presence, whole_frame


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
    first, second = presence_findings(presence, source.fps)
    assert (first.severity, first.cameras) == ("warning", (list(rig)[1],))
    assert "lacks 2 of 8 frames, the first of them frame 2 (0.07 s)" in first.sentence
    assert "ends with frame 4 (0.13 s) and is absent from the 3 frames after that" in second.sentence


@pytest.mark.parametrize("present", [[True] * 3, [False] * 3])
def test_all_and_nothing(present: list[bool]) -> None:
    found = presence_findings({"a": np.array(present)}, 30.0)
    assert [finding.sentence for finding in found] == (
        [] if all(present) else [
            "Camera 'a' has no picture of any frame that can be read; leave it out, or restore its files."
        ]
    )  # fmt: skip
