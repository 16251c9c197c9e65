# SPDX-License-Identifier: Apache-2.0
"""The part of a capture that a stream was made from is found again by its header."""

from dataclasses import replace

import pytest

from structgstream.data.open import open_capture
from structgstream.errors import CaptureError
from structgstream.evaluation.recording import capture_of, captures_of, check_same_rig
from tests.support.small_clip import small_clip_path
from tests.support.streams import header_for, small_scene

CLIP = small_clip_path()


@pytest.mark.parametrize(("scale", "size"), [(0.25, (80, 60)), (0.33, (106, 79))])
def test_start_step_and_scale_are_those_of_the_stream(scale: float, size: tuple[int, int]) -> None:
    """At 0.33 the width is rounded up and the height down, so that neither gives the scale back."""
    made_from = open_capture(CLIP, start=1, scale=scale, every=3)
    header = replace(header_for(small_scene()), rig=made_from.rig, metadata={"start": 1, "every": 3})
    assert [len(capture_of(header, CLIP, frames=frames)) for frames in (2, 99, None)] == [2, 4, 4]
    found = capture_of(header, CLIP, frames=2)
    assert found.fps == made_from.fps
    assert (found.rig["cam01"].width, found.rig["cam01"].height) == size
    check_same_rig(header, found, tuple(header.rig))
    for one, wanted in zip(found.frames(), made_from.frames(), strict=False):
        assert (one.images["cam01"] == wanted.images["cam01"]).all()
    assert len(capture_of(replace(header, metadata={"start": 3}), CLIP, frames=None)) == 9


def test_stored_pictures_are_found_where_they_are_larger() -> None:
    made_from = open_capture(CLIP, start=3, scale=0.5, every=2)
    header = replace(header_for(small_scene()), rig=made_from.rig, metadata={"start": 3, "every": 2})
    _, found = captures_of(header, CLIP, frames=3)
    assert found is not None
    assert len(found) == 3
    assert (found.rig["cam01"].width, found.rig["cam01"].height) == (320, 240)
    wanted = [frame.images["cam01"] for frame in open_capture(CLIP, start=3, frames=5).frames()]
    for frame, number in zip(found.frames(), (0, 2, 4), strict=True):
        assert (frame.images["cam01"] == wanted[number]).all()
    whole = replace(header, rig=open_capture(CLIP).rig)
    assert captures_of(whole, CLIP, frames=3)[1] is None


def test_a_capture_that_ends_before_the_stream_begins_is_reported() -> None:
    header = replace(header_for(small_scene()), metadata={"start": 12})
    with pytest.raises(CaptureError, match="12 frames"):
        capture_of(header, CLIP, frames=1)
