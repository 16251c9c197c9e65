# SPDX-License-Identifier: Apache-2.0
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

from structgstream.cameras import CameraRig
from structgstream.data.dataset_layouts import open_json_videos
from structgstream.data.source import Prefetch
from structgstream.errors import CaptureError
from structgstream.frames import MultiViewFrame
from tests.support.captures import picture, small_rig, write_clip


@dataclass
class Scripted:
    """A source in memory that notes what was decoded and whether it was closed, and can fail at a frame."""

    fails_at: int | None = None
    rig: CameraRig = field(default_factory=small_rig)
    fps: float = 30.0
    name: str = "scripted"
    points: None = None
    decoded: list[int] = field(default_factory=list)
    reached: threading.Semaphore = field(default_factory=lambda: threading.Semaphore(0))
    closed: threading.Event = field(default_factory=threading.Event)

    def __len__(self) -> int:
        return 6

    def frames(self, start: int = 0) -> Iterator[MultiViewFrame]:
        try:
            for index in range(start, len(self)):
                if index == self.fails_at:
                    raise CaptureError(f"frame {index} is broken")
                self.decoded.append(index)
                self.reached.release()
                yield MultiViewFrame(index, index / self.fps, {name: picture(0, index) for name in self.rig})
        finally:
            self.closed.set()


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


def test_it_stands_for_its_source() -> None:
    source = Scripted()
    ahead = Prefetch(source)
    assert (ahead.rig, ahead.fps, ahead.name, len(ahead)) == (source.rig, 30.0, "scripted", 6)


def test_it_decodes_ahead_but_not_further_than_its_depth() -> None:
    source = Scripted()
    frames = Prefetch(source).frames()
    assert next(frames).index == 0
    for _ in range(3):  # the one taken and two ahead
        assert source.reached.acquire(timeout=10)
    assert not source.reached.acquire(timeout=0.1)
    assert source.decoded == [0, 1, 2]
    frames.close()  # type: ignore[attr-defined]


def test_an_error_comes_at_its_frame() -> None:
    frames = Prefetch(Scripted(fails_at=3)).frames()
    assert [next(frames).index for _ in range(3)] == [0, 1, 2]
    with pytest.raises(CaptureError, match="frame 3 is broken"):
        next(frames)
    assert no_thread_is_left()


def test_closing_stops_the_thread_and_closes_the_source() -> None:
    source = Scripted()
    frames = Prefetch(source).frames()
    next(frames)
    frames.close()  # type: ignore[attr-defined]
    assert no_thread_is_left()
    assert source.closed.is_set()
    assert len(source.decoded) < 5


def test_an_interrupt_in_the_consumer_stops_the_thread() -> None:
    source = Scripted()

    def consume() -> None:
        for _ in Prefetch(source).frames():
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt) as caught:
        consume()
    del caught
    assert source.closed.wait(timeout=10)
