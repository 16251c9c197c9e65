# SPDX-License-Identifier: Apache-2.0
"""The part of a capture that a stream was made from is found again by its header."""

from dataclasses import replace

import pytest

from structgstream.data.dataset_layouts import bundled_clip_path
from structgstream.data.open import open_capture
from structgstream.errors import CaptureError
from structgstream.evaluation.recording import capture_of, captures_of
from tests.support.streams import header_for, small_scene


@pytest.mark.parametrize(("frames", "expected"), [(2, 2), (99, 9), (None, 9)])
def test_start_frames_and_scale_are_those_of_the_stream(frames: int | None, expected: int) -> None:
    made_from = open_capture(bundled_clip_path(), start=3, scale=0.25)
    header = replace(header_for(small_scene()), rig=made_from.rig, metadata={"start": 3})
    found = capture_of(header, bundled_clip_path(), frames=frames)
    assert len(found) == expected
    camera = found.rig["cam01"]
    assert (camera.width, camera.height) == (80, 60)
    first, wanted = next(iter(found.frames())), next(iter(made_from.frames()))
    assert (first.images["cam01"] == wanted.images["cam01"]).all()


@pytest.mark.parametrize(("frames", "expected"), [(2, 2), (99, 4), (None, 4)])
def test_every_third_frame_is_found_again(frames: int | None, expected: int) -> None:
    made_from = open_capture(bundled_clip_path(), start=1, scale=0.25, every=3)
    header = replace(header_for(small_scene()), rig=made_from.rig, metadata={"start": 1, "every": 3})
    found = capture_of(header, bundled_clip_path(), frames=frames)
    assert (len(found), found.fps) == (expected, made_from.fps)
    for one, wanted in zip(found.frames(), made_from.frames(), strict=False):
        assert (one.images["cam01"] == wanted.images["cam01"]).all()


def test_stored_pictures_are_found_where_they_are_larger() -> None:
    made_from = open_capture(bundled_clip_path(), start=3, scale=0.5, every=2)
    header = replace(header_for(small_scene()), rig=made_from.rig, metadata={"start": 3, "every": 2})
    _, found = captures_of(header, bundled_clip_path(), frames=3)
    assert found is not None
    assert len(found) == 3
    assert (found.rig["cam01"].width, found.rig["cam01"].height) == (320, 240)
    wanted = [frame.images["cam01"] for frame in open_capture(bundled_clip_path()).frames()]
    for frame, number in zip(found.frames(), (3, 5, 7), strict=True):
        assert (frame.images["cam01"] == wanted[number]).all()
    whole = replace(header, rig=open_capture(bundled_clip_path()).rig)
    assert captures_of(whole, bundled_clip_path(), frames=3)[1] is None


def test_a_capture_that_ends_before_the_stream_begins_is_reported() -> None:
    header = replace(header_for(small_scene()), metadata={"start": 12})
    with pytest.raises(CaptureError, match="12 frames"):
        capture_of(header, bundled_clip_path(), frames=1)
