# SPDX-License-Identifier: Apache-2.0
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from structgstream.data.dataset_layouts import open_json_videos, open_panoptic
from structgstream.data.images import ImageSource
from structgstream.data.source import (
    FrameSource,
    SourceWrapper,
    WithoutPoints,
    WithRig,
    apart_seconds,
    every_nth_frame,
    resized,
    section,
    select_cameras,
    unwrapped,
)
from structgstream.errors import CaptureError, ConfigError
from tests.support.captures import all_numbers, numbers, write_clip, write_panoptic


@pytest.fixture(params=["pictures", "videos"])
def source(request: pytest.FixtureRequest, tmp_path: Path) -> FrameSource:
    if request.param == "pictures":
        write_panoptic(tmp_path, frames=6)
        return open_panoptic(tmp_path)
    write_clip(tmp_path)
    return open_json_videos(tmp_path)


@pytest.mark.parametrize(("scale", "size"), [(0.5, (32, 24)), (0.33, (21, 16)), (0.01, (1, 1))])
def test_pictures_and_intrinsics_shrink_together(source: FrameSource, scale: float, size: tuple[int, int]) -> None:
    small = resized(source, scale)
    for name in small.rig:
        before, after = source.rig[name], small.rig[name]
        assert (after.width, after.height) == size
        ratio = torch.tensor([[size[0] / 64], [size[1] / 48], [1.0]], dtype=torch.float64)
        torch.testing.assert_close(after.K, before.K * ratio)
        assert torch.equal(after.viewmat, before.viewmat)
    frame = next(small.frames(2))
    assert {image.shape for image in frame.images.values()} == {(size[1], size[0], 3)}
    if scale > 0.1:
        assert [numbers(image) for image in frame.images.values()] == [(camera, 2) for camera in range(4)]


def test_shrinking_averages_areas(source: FrameSource) -> None:
    full, half = next(source.frames()), next(resized(source, 0.5).frames())
    for name in source.rig:
        expected = full.images[name].reshape(24, 2, 32, 2, 3).mean(axis=(1, 3))
        np.testing.assert_allclose(half.images[name], expected, atol=1.5)


def test_scale_one_changes_nothing_and_others_are_refused(source: FrameSource) -> None:
    assert resized(source, 1.0) is source
    for scale in (0.0, -1.0, 1.5, float("nan")):
        with pytest.raises(ConfigError, match="scale of a capture"):
            resized(source, scale)


def test_a_section_counts_and_times_from_zero(source: FrameSource) -> None:
    part = section(source, start=2, frames=3)
    assert len(part) == 3
    frames = list(part.frames())
    assert [frame.index for frame in frames] == [0, 1, 2]
    assert [frame.pts_seconds for frame in frames] == pytest.approx([0, 1 / part.fps, 2 / part.fps])
    assert all_numbers(frames) == all_numbers(source.frames())[2:5]
    assert all_numbers(part.frames(1)) == all_numbers(frames)[1:]
    assert list(part.frames(3)) == []


def test_a_section_must_lie_inside(source: FrameSource) -> None:
    assert section(source) is source
    assert len(section(source, start=5)) == 1
    for start, frames in ((6, None), (-1, None), (0, 7), (4, 3), (0, 0)):
        with pytest.raises(CaptureError, match="has 6 frames"):
            section(source, start=start, frames=frames)


def test_another_rig_keeps_the_frames(source: FrameSource) -> None:
    names = list(source.rig)
    other = WithRig(source, source.rig.with_held_out(frozenset(names[1:2])))
    assert other.rig.testing == (names[1],)
    assert all_numbers(other.frames(4)) == all_numbers(source.frames(4))
    assert (other.name, other.fps, len(other), other.points) == (source.name, source.fps, 6, None)


@pytest.mark.parametrize(("wanted", "kept"), [((2, 1), [1, 2]), ((3,), [0, 3])])
def test_the_cameras_that_are_asked_for_give_the_same_pictures(
    source: FrameSource, wanted: tuple[int, ...], kept: list[int]
) -> None:
    """Through every wrapper, and one more camera where a rig would have one alone."""
    whole = section(WithRig(resized(source, 0.5), resized(source, 0.5).rig), start=1, frames=4)
    names = [*whole.rig]
    part = select_cameras(whole, tuple(names[i] for i in wanted))
    assert [*part.rig] == [names[i] for i in kept]
    assert len(part) == len(whole) == 4
    for frame, expected in zip(part.frames(1), whole.frames(1), strict=True):
        assert (frame.index, frame.pts_seconds) == (expected.index, expected.pts_seconds)
        assert [*frame.images] == [*part.rig]
        for name, image in frame.images.items():
            np.testing.assert_array_equal(image, expected.images[name])


def test_a_source_of_another_kind_keeps_its_cameras(source: FrameSource) -> None:
    class Other:
        rig = source.rig

    other: Any = Other()
    assert select_cameras(other, (*source.rig,)[:2]) is other


def test_every_third_frame_counts_from_zero_and_keeps_the_time(source: FrameSource) -> None:
    few = every_nth_frame(source, 3)
    assert (len(few), few.fps) == (2, source.fps / 3)
    assert all_numbers(few.frames()) == [all_numbers(source.frames())[i] for i in (0, 3)]
    assert [frame.index for frame in few.frames()] == [0, 1]
    assert [frame.pts_seconds for frame in few.frames()] == pytest.approx([0.0, 3 / source.fps])
    assert [frame.index for frame in few.frames(1)] == [1]
    assert all_numbers(few.frames(1)) == [all_numbers(source.frames())[3]]
    assert list(few.frames(2)) == []


def test_steps_of_a_thinned_capture(source: FrameSource) -> None:
    assert every_nth_frame(source, 1) is source
    assert [len(every_nth_frame(source, step)) for step in (2, 4, 5, 6, 7)] == [3, 2, 2, 1, 1]
    part = every_nth_frame(section(source, start=1, frames=5), 4)
    assert all_numbers(part.frames()) == [all_numbers(source.frames())[i] for i in (1, 5)]
    for step in (0, -1):
        with pytest.raises(ConfigError, match="at least 1, got"):
            every_nth_frame(source, step)


def test_frames_that_stand_for_all_keep_the_rate(source: FrameSource) -> None:
    few = every_nth_frame(source, 3, rate=source.fps)
    assert few.fps == source.fps
    assert [frame.pts_seconds for frame in few.frames()] == pytest.approx([0.0, 1 / source.fps])


def test_a_thinned_section_begins_at_the_start_and_counts_what_is_used(source: FrameSource) -> None:
    taken = {
        (1, None, 2): (1, 3, 5), (1, 2, 2): (1, 3), (2, 1, 3): (2,), (0, None, 4): (0, 4), (5, None, 2): (5,),
    }  # fmt: skip
    whole = all_numbers(source.frames())
    for (start, frames, every), expected in taken.items():
        part = section(source, start=start, frames=frames, every=every)
        assert all_numbers(part.frames()) == [whole[i] for i in expected]
        assert part.fps == source.fps / every
    part = section(source, start=1, frames=1, every=2)
    assert isinstance(part, SourceWrapper)
    assert all_numbers(part.frames_after()) == [whole[3], whole[5]]  # what a look ahead may see has the same step
    for start, frames, every in ((0, 4, 2), (6, None, 2), (-1, 1, 2), (0, 0, 3)):
        with pytest.raises(CaptureError, match=f"has 6 frames; .*1 in {every}"):
            section(source, start=start, frames=frames, every=every)


@pytest.mark.parametrize("source", ["pictures"], indirect=True)
def test_pictures_between_are_not_opened(source: FrameSource) -> None:
    assert isinstance(source, ImageSource)
    for name in source.rig:
        between = source.files[name][1]
        assert between is not None
        between.write_bytes(b"broken")
    assert len(list(section(source, every=2).frames())) == 3
    with pytest.raises(CaptureError, match="cannot be decoded"):
        list(source.frames())


def test_times_of_pictures_are_those_of_the_source_below(tmp_path: Path) -> None:
    write_clip(tmp_path)
    videos = open_json_videos(tmp_path)
    assert set(apart_seconds(WithoutPoints(videos))) == set(videos.rig)
    assert all(len(apart) == len(videos) for apart in apart_seconds(WithoutPoints(videos)).values())
    assert apart_seconds(section(videos, start=1)) == {}, "counted from another frame"
    assert unwrapped(WithoutPoints(videos)) is videos


def test_pictures_without_times(tmp_path: Path) -> None:
    write_panoptic(tmp_path, frames=2)
    assert apart_seconds(open_panoptic(tmp_path)) == {}
