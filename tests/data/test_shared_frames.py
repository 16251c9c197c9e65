# SPDX-License-Identifier: Apache-2.0
"""Several readers of one capture get the same frames, each of which is read once."""

import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field

import numpy as np
import pytest

from structgstream.cameras import CameraRig
from structgstream.data.source import SharedFrames, frame_count, is_recording, retain_frames
from structgstream.errors import CaptureError
from structgstream.frames import MultiViewFrame
from tests.support.rigs import arc_rig


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
