# SPDX-License-Identifier: Apache-2.0
"""Several readers of one capture get the same frames, each of which is read once."""

import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from structgstream.cameras import CameraRig
from structgstream.data.dataset_layouts import open_json_videos, open_panoptic
from structgstream.data.images import ImageSource
from structgstream.data.source import (
    FrameSource,
    Prefetch,
    SharedFrames,
    SourceWrapper,
    WithoutPoints,
    WithRig,
    apart_seconds,
    every_nth_frame,
    frame_count,
    is_recording,
    resized,
    retain_frames,
    section,
    select_cameras,
    unwrapped,
)
from structgstream.errors import CaptureError, ConfigError
from structgstream.frames import MultiViewFrame
from tests.support.captures import all_numbers, numbers, write_clip, write_panoptic
from tests.support.rigs import arc_rig


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
    for step in (0, -1):
        with pytest.raises(ConfigError, match="at least 1, got"):
            every_nth_frame(source, step)


def test_frames_that_stand_for_all_keep_the_rate(source: FrameSource) -> None:
    few = every_nth_frame(source, 3, rate=source.fps)
    assert few.fps == source.fps
    assert [frame.pts_seconds for frame in few.frames()] == pytest.approx([0.0, 1 / source.fps])


def test_a_thinned_section_begins_at_the_start_and_counts_what_is_used(source: FrameSource) -> None:
    taken = {
        (1, None, 2): (1, 3, 5), (1, 2, 2): (1, 3), (1, None, 4): (1, 5), (2, 1, 3): (2,), (5, None, 2): (5,),
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


def no_thread_is_left() -> bool:
    return not any(thread.name.startswith("lookahead") for thread in threading.enumerate())


def test_frames_are_the_same_with_and_without(tmp_path: Path) -> None:
    write_clip(tmp_path)
    source = open_json_videos(tmp_path)
    plain, ahead = list(source.frames(1)), list(Prefetch(source).frames(1))
    assert [(a.index, a.pts_seconds) for a in plain] == [(b.index, b.pts_seconds) for b in ahead]
    for a, b in zip(plain, ahead, strict=True):
        assert list(a.images) == list(b.images)
        assert all(np.array_equal(a.images[name], b.images[name]) for name in a.images)
    assert no_thread_is_left()


@dataclass
class Filmed:
    """Frames that say when they were read, and what is to be kept."""

    count: int = 6
    fails_at: int | None = None
    rig: CameraRig = field(default_factory=lambda: arc_rig(3, width=8, height=6))
    fps: float = 30.0
    name: str = "filmed"
    points: np.ndarray | None = None

    def __post_init__(self) -> None:
        self.read: list[int] = []
        self.closed = 0
        self.kept: list[tuple[tuple[int, ...], int]] = []

    def retain(self, *first: int, last: int) -> None:
        self.kept.append((first, last))

    def frames(self, start: int = 0) -> Iterator[MultiViewFrame]:
        try:
            for index in range(start, self.count):
                self.read.append(index)
                if index == self.fails_at:
                    raise CaptureError("the disk is gone")
                yield MultiViewFrame(index, index / 30, {})
        finally:
            self.closed += 1


class Recorded(Filmed):
    """The same as a recording, whose length is known."""

    def __len__(self) -> int:
        return self.count


def indices(frames: Iterator[MultiViewFrame], count: int) -> list[int]:
    return [next(frames).index for _ in range(count)]


def test_each_frame_is_read_once_and_given_to_all() -> None:
    source = Filmed()
    shared = SharedFrames(source, starts=[0, 0, 0], first=[0, 0, 0])
    streams = [reader.frames(0) for reader in shared.readers]
    for index in range(6):
        one, *others = [next(stream) for stream in streams]
        assert one.index == index
        assert all(other is one for other in others)
        assert source.read == [*range(index + 1)], "nothing is asked for early"
    assert [next(stream, None) for stream in streams] == [None] * 3
    assert source.read == [*range(6)]


def test_frames_that_all_readers_had_are_dropped() -> None:
    shared = SharedFrames(Filmed(), starts=[0, 0], first=[0, 0])
    fast, slow = (reader.frames(0) for reader in shared.readers)
    assert indices(fast, 3) == [0, 1, 2]
    assert sorted(shared._cached) == [0, 1, 2]
    assert indices(slow, 3) == [0, 1, 2]
    assert sorted(shared._cached) == [2]


def test_one_that_lacks_a_frame_begins_before_the_others() -> None:
    source = Filmed()
    shared = SharedFrames(source, starts=[3, 2], first=[0, 0])
    ahead, behind = shared.readers
    catching_up = behind.frames(2)
    assert indices(catching_up, 2) == [2, 3]
    assert indices(ahead.frames(3), 3) == [3, 4, 5]
    assert indices(catching_up, 2) == [4, 5]
    assert source.read == [2, 3, 4, 5]


def test_older_frames_are_read_again_and_the_reading_goes_on() -> None:
    """As a run does that is resumed, before and after it has begun to read."""
    source = Filmed()
    shared = SharedFrames(source, starts=[4, 4], first=[1, 1])
    one, other = shared.readers
    assert next(one.frames(1)).index == 1
    reading = one.frames(4)
    assert indices(reading, 1) == [4]
    assert next(other.frames(1)).index == 1
    assert next(other.frames(4)).index == 4, "a look at the first one is no reading"
    assert indices(other.frames(4), 2) == [4, 5]
    assert indices(reading, 1) == [5]
    assert source.read == [1, 4, 1, 5]
    assert source.closed == 2
    shared.close()
    assert source.closed == 3


def test_what_is_to_be_kept_is_what_any_of_them_needs() -> None:
    source = Filmed()
    shared = SharedFrames(source, starts=[5, 5], first=[0, 3])
    retain_frames(shared.readers[0], 4, last=2)
    retain_frames(shared.readers[1], 4, last=1)
    assert source.kept == [((0, 3), 0), ((4, 3), 2), ((4,), 2)]


@pytest.mark.parametrize("kind", [Filmed, Recorded])
def test_a_reader_is_the_kind_of_stream_that_the_source_is(kind: type[Filmed]) -> None:
    source = kind()
    for reader in SharedFrames(source, starts=[0, 0], first=[0, 0]).readers:
        assert frame_count(reader) == frame_count(source)
        assert is_recording(reader) == is_recording(source)
        assert (reader.fps, reader.name, reader.points) == (30.0, "filmed", None)
        assert reader.rig is source.rig


def test_an_error_of_the_source_is_everyones() -> None:
    shared = SharedFrames(Filmed(fails_at=1), starts=[0, 0], first=[0, 0])
    for reader in shared.readers:
        frames = reader.frames(0)
        assert next(frames).index == 0
        with pytest.raises(CaptureError, match="the disk is gone"):
            next(frames)


def test_what_is_held_is_given_while_another_waits_for_a_camera() -> None:
    """One that reads ahead does not hold up those who need what is there."""
    filmed = threading.Semaphore(1)

    class Slow(Filmed):
        def frames(self, start: int = 0) -> Iterator[MultiViewFrame]:
            for frame in super().frames(start):
                filmed.acquire()
                yield frame

    shared = SharedFrames(Slow(), starts=[0, 0, 0], first=[0, 0, 0])
    ahead, behind, other = (reader.frames(0) for reader in shared.readers)
    assert next(ahead).index == 0
    with ThreadPoolExecutor(2) as threads:
        waiting = [threads.submit(next, ahead)]
        assert next(behind).index == 0
        waiting.append(threads.submit(next, behind))
        assert next(other).index == 0
        assert not any(one.done() for one in waiting)
        filmed.release()
        assert [one.result().index for one in waiting] == [1, 1]
    assert next(other).index == 1
