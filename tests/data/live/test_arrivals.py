# SPDX-License-Identifier: Apache-2.0
"""Cameras of files at work, and what is told of those that are out of step."""

import re
import time
from pathlib import Path

import numpy as np
import pytest

from structgstream.data.live.arrivals import Arrivals
from structgstream.data.live.faults import FaultLog
from structgstream.data.live.matching import LivePicture, PictureSet
from structgstream.data.live.outlets import QueueStatus
from structgstream.data.live.rig_file import LiveCamera, LiveRig

SIZE = (64, 48)
PERIOD = 1 / 30


class Taken:
    """An outlet that keeps sets, and may fail."""

    def __init__(self, *, fails: Exception | None = None) -> None:
        self.sets: list[PictureSet] = []
        self.waiting, self._fails = 0, fails

    def put(self, found: PictureSet) -> None:
        if self._fails is not None:
            raise self._fails
        self.sets.append(found)

    def take(self, timeout_seconds: float) -> None:
        return None

    def ahead(self, number: int, timeout_seconds: float) -> None:
        return None

    @property
    def taken(self) -> None:
        return None

    @property
    def status(self) -> QueueStatus:
        return QueueStatus(self.waiting, 0, 0)

    def close(self) -> None:
        """Nothing is open."""


class Bench:
    """Arrivals of cameras that nobody opens, in a time that a test moves."""

    def __init__(self, *names: str, end_seconds: float | None = None, fails: Exception | None = None) -> None:
        self.now = 100.0
        self.outlet, self.faults = Taken(fails=fails), FaultLog("rig", now=lambda: self.now)
        cameras = {name: LiveCamera("udp://nowhere") for name in names}
        rig = LiveRig("rig", Path("nowhere"), cameras, deadline_seconds=0.5, end_seconds=end_seconds)
        self.arrivals = Arrivals(
            rig, sizes=dict.fromkeys(names, SIZE), fps=30.0, faults=self.faults, outlet=self.outlet, recording=None,
            now=lambda: self.now, unix_offset=0.0,
        )  # fmt: skip

    def send(self, seconds: float, *names: str) -> None:
        for name in names:
            self.arrivals.deliver(name, LivePicture(seconds, seconds, np.zeros(1)))

    def running(self) -> "Bench":
        """With the thread that makes sets, without those of cameras."""
        self.arrivals._thread.start()
        return self

    def wait(self, sets: int) -> None:
        last = time.monotonic() + 20.0
        while self.arrivals.sets < sets:
            assert time.monotonic() < last
            time.sleep(0.005)


def test_sets_go_to_the_outlet() -> None:
    bench = Bench("a", "b").running()
    for index in range(3):
        bench.now = 100.0 + index * PERIOD
        bench.send(bench.now, "a", "b")
        bench.wait(index + 1)
    assert [set(one.pictures) for one in bench.outlet.sets] == [{"a", "b"}] * 3
    assert bench.arrivals.present == ["a", "b"]
    assert bench.arrivals.lengths == {"a": 0, "b": 0}
    bench.arrivals._stop.set()


def test_who_sends_is_present_until_the_deadline() -> None:
    bench = Bench("a", "b", "c")
    assert bench.arrivals.present == ["a", "b", "c"]  # nobody is missed before the first deadline
    bench.now = 101.0
    assert bench.arrivals.present == []
    assert bench.arrivals.waiting_for() == "0 of 3 cameras send; absent: a, b, c"
    bench.send(101.0, "a", "b")
    assert bench.arrivals.lengths == {"a": 1, "b": 1, "c": 0}
    assert bench.arrivals.waiting_for() == "2 of 3 cameras send; absent: c"
    bench.send(101.1, "c")
    assert bench.arrivals.waiting_for() == "3 of 3 cameras send; absent: none"
    bench.arrivals.lost("a")
    assert "absent: a" in bench.arrivals.waiting_for()
    bench.now = 101.55
    assert bench.arrivals.present == ["c"]


def test_an_error_of_the_outlet_reaches_the_trainer() -> None:
    bench = Bench("a", fails=OSError("the disk is gone")).running()
    bench.send(100.0, "a")
    last = time.monotonic() + 20.0
    while bench.arrivals._failed is None:
        assert time.monotonic() < last
        time.sleep(0.005)
    with pytest.raises(OSError, match="the disk is gone"):
        _ = bench.arrivals.ended


def test_a_silent_rig_ends_after_its_time_and_not_while_sets_wait() -> None:
    bench = Bench("a", "b", end_seconds=10.0)
    bench.send(103.0, "a")
    bench.now = 113.0
    assert bench.arrivals.ended is None
    bench.now = 114.0
    bench.outlet.waiting = 1
    assert bench.arrivals.ended is None
    bench.outlet.waiting = 0
    assert bench.arrivals.ended == (
        "no camera has sent a picture for 11 s, so the stream ends (end_seconds in the rig file)"
    )
    assert Bench("a").arrivals.ended is None


def test_files_that_end_end_the_stream_when_everything_was_taken() -> None:
    bench = Bench("a", "b")
    for feed in bench.arrivals.feeds.values():
        feed.ended = True
    bench.send(100.0, "a", "b")
    assert bench.arrivals.ended is None
    bench.running().wait(1)
    bench.arrivals._stop.set()
    bench.outlet.waiting = 1
    assert bench.arrivals.ended is None
    bench.outlet.waiting = 0
    assert bench.arrivals.ended == "all files of cameras have come to their end, or cannot be read"
    bench.arrivals.feeds["b"].ended = False
    assert bench.arrivals.ended is None


def test_others_that_change_are_those_of_other_cameras() -> None:
    bench = Bench("a", "b")
    bench.arrivals.feeds["a"].changed_at = 7.0
    assert bench.arrivals.others_changed_at("b") == 7.0
    assert Bench("a").arrivals.others_changed_at("a") == -float("inf")


@pytest.mark.parametrize(
    ("seconds", "said"),
    [
        (-0.125, "are 0.125 s behind those of the others: .* offset_seconds = [+]0.125 in the rig file mends"),
        (0.25, "are 0.250 s ahead of those of the others: its clock is, which offset_seconds = -0.250"),
    ],
)
def test_a_camera_out_of_step_is_told_with_its_remedy(
    seconds: float, said: str, caplog: pytest.LogCaptureFixture
) -> None:
    bench = Bench("a", "b")
    bench.arrivals._tell_astray({"b": seconds})
    (record,) = caplog.records
    assert "b" in record.getMessage()
    assert re.search(said, record.getMessage())


def test_small_sets_are_counted() -> None:
    bench = Bench("a")
    bench.arrivals.count_small()
    assert bench.arrivals.small == 1
