# SPDX-License-Identifier: Apache-2.0
"""Cameras of files at work, and what is reported of those out of step."""

import re
import threading
from pathlib import Path

import numpy as np
import pytest

from structgstream.data.live.ingest import Ingest
from structgstream.data.live.rig_file import LiveCamera, LiveRig
from structgstream.data.live.status import FaultLog
from structgstream.data.live.synchronizer import FrameSynchronizer, LivePicture
from tests.support.waiting import wait_until

SIZE = (64, 48)
PERIOD = 1 / 30


class Bench:
    """Ingest of cameras that nobody opens, in a time that a test moves."""

    def __init__(self, *names: str, end_seconds: float | None = None) -> None:
        self.now, faults = 100.0, FaultLog("rig", now=lambda: 0.0)
        cameras = {name: LiveCamera("udp://nowhere") for name in names}
        rig = LiveRig("rig", Path("nowhere"), cameras, deadline_seconds=0.5, end_seconds=end_seconds)
        self.ingest = Ingest(
            rig, sizes=dict.fromkeys(names, SIZE), fps=30.0, faults=faults, recording=None, now=lambda: self.now,
            unix_offset=0.0,
        )  # fmt: skip

    def send(self, seconds: float, *names: str) -> None:
        for name in names:
            self.ingest._synchronizer.add(name, LivePicture(seconds, seconds, np.zeros(1)))

    def running(self) -> "Bench":
        """With the thread that makes sets, without those of cameras."""
        self.ingest._thread.start()
        return self

    def wait(self, sets: int) -> None:
        wait_until(lambda: self.ingest.sets >= sets)


def test_the_newest_set_is_taken_and_the_others_are_counted() -> None:
    bench, found = Bench("a", "b").running(), []
    for index in range(3):
        bench.now = 100.0 + index * PERIOD
        bench.send(bench.now, "a", "b")
        bench.wait(index + 1)
    newest = bench.ingest.take(0.0)
    assert newest is not None
    assert (newest.seconds, set(newest.pictures)) == (bench.now, {"a", "b"})
    assert bench.ingest.skipped_sets == 2
    assert bench.ingest.present == ["a", "b"]
    assert bench.ingest.queue_lengths == {"a": 0, "b": 0}
    waiting = threading.Thread(target=lambda: found.append(bench.ingest.take(10.0)))
    waiting.start()
    bench.now += PERIOD
    bench.send(bench.now, "a", "b")
    waiting.join(10.0)
    assert found[0].seconds == bench.now
    bench.ingest._stop.set()


def test_who_sends_is_present_until_the_deadline() -> None:
    bench = Bench("a", "b", "c")
    assert bench.ingest.present == ["a", "b", "c"]  # nobody is missed before the first deadline
    bench.now = 101.0
    assert bench.ingest.present == []
    assert bench.ingest.describe_absent() == "0 of 3 cameras send; absent: a, b, c"
    bench.send(101.0, "a", "b")
    assert bench.ingest.queue_lengths == {"a": 1, "b": 1, "c": 0}
    assert bench.ingest.describe_absent() == "2 of 3 cameras send; absent: c"
    bench.send(101.1, "c")
    assert bench.ingest.describe_absent() == "3 of 3 cameras send; absent: none"
    bench.ingest._synchronizer.mark_absent("a")
    assert "absent: a" in bench.ingest.describe_absent()
    bench.now = 101.55
    assert bench.ingest.present == ["c"]


def test_an_error_of_the_synchronizer_reaches_the_trainer(monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(synchronizer: FrameSynchronizer, now: float) -> None:
        raise OSError("the disk is gone")

    monkeypatch.setattr(FrameSynchronizer, "next_set", fails)
    bench = Bench("a").running()
    wait_until(lambda: bench.ingest._failure is not None)
    with pytest.raises(OSError, match="the disk is gone"):
        _ = bench.ingest.end_reason


def test_a_silent_rig_ends_after_its_time_and_not_while_sets_wait() -> None:
    bench = Bench("a", "b", end_seconds=10.0).running()
    bench.send(103.0, "a", "b")
    bench.wait(1)
    bench.now = 114.0
    assert bench.ingest.end_reason is None
    bench.ingest.take(0.0)
    bench.now = 113.0
    assert bench.ingest.end_reason is None
    bench.now = 114.0
    assert bench.ingest.end_reason == (
        "no camera has sent a picture for 11 s, so the stream ends (end_seconds in the rig file)"
    )
    bench.ingest._stop.set()
    assert Bench("a").ingest.end_reason is None


def test_files_that_end_end_the_stream_when_everything_was_taken() -> None:
    bench = Bench("a", "b")
    for feed in bench.ingest.feeds.values():
        feed.ended = True
    bench.send(100.0, "a", "b")
    assert bench.ingest.end_reason is None
    bench.running().wait(1)
    bench.ingest._stop.set()
    assert bench.ingest.end_reason is None
    bench.ingest.take(0.0)
    assert bench.ingest.end_reason == "all files of cameras have come to their end, or cannot be read"
    bench.ingest.feeds["b"].ended = False
    assert bench.ingest.end_reason is None


@pytest.mark.parametrize(
    ("seconds", "said"),
    [
        (-0.125, "are 0.125 s behind those of the others: .* offset_seconds = [+]0.125 in the rig file mends"),
        (0.25, "are 0.250 s ahead of those of the others: its clock is, which offset_seconds = -0.250"),
    ],
)
def test_a_camera_out_of_step_is_reported_with_its_remedy(
    seconds: float, said: str, caplog: pytest.LogCaptureFixture
) -> None:
    bench = Bench("a", "b")
    bench.ingest._warn_out_of_step({"b": seconds})
    (record,) = caplog.records
    assert "b" in record.getMessage()
    assert re.search(said, record.getMessage())


def test_each_camera_knows_when_the_others_changed() -> None:
    first, second = Bench("a", "b").ingest.feeds.values()
    assert first._changed_at is second._changed_at
