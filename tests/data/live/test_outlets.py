# SPDX-License-Identifier: Apache-2.0
"""The newest set, or all of them through files."""

import logging
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from structgstream.data.live.matching import LivePicture, PictureSet
from structgstream.data.live.outlets import MAX_UNWRITTEN, PURPOSE, DiskQueue, Latest
from structgstream.errors import StorageError
from structgstream.frames import MultiViewFrame
from structgstream.owned_folders import own_folder

WAIT = 10.0


def one_set(number: int) -> PictureSet:
    return PictureSet(float(number), {"a": LivePicture(float(number), float(number), number)}, float(number))


def convert(found: PictureSet) -> MultiViewFrame:
    """Pictures that do not compress, so that files have a known size: 3 kB."""
    number = found.pictures["a"].content
    image = np.random.default_rng(number).integers(0, 256, (32, 32, 3)).astype(np.uint8)
    return MultiViewFrame(0, found.seconds, {"a": image})


def test_latest_hands_out_the_newest_and_counts_the_others() -> None:
    outlet = Latest(convert)
    assert outlet.take(0.0) is None
    for number in range(5):
        outlet.put(one_set(number))
    frame = outlet.take(0.0)
    assert frame is not None
    assert frame.pts_seconds == 4.0
    assert outlet.take(0.0) is None
    assert outlet.status.skipped == 4


def test_latest_wakes_who_waits() -> None:
    outlet, found = Latest(convert), []
    waiting = threading.Thread(target=lambda: found.append(outlet.take(WAIT)))
    waiting.start()
    outlet.put(one_set(3))
    waiting.join(WAIT)
    assert found[0].pts_seconds == 3.0


def taken(outlet: DiskQueue) -> float:
    frame = outlet.take(WAIT)
    assert frame is not None
    return frame.pts_seconds


def test_every_set_comes_in_order_from_the_disk(tmp_path: Path) -> None:
    outlet = DiskQueue(tmp_path / "q", max_bytes=10**6, convert=convert)
    for number in range(20):
        outlet.put(one_set(number))
        if number % 5 == 4:
            assert [taken(outlet) for _ in range(5)] == list(range(number - 4, number + 1))
    assert outlet.status.skipped == 0
    outlet.close()
    assert not (tmp_path / "q").exists()


def test_sets_that_are_looked_at_ahead_are_taken_later_as_well(tmp_path: Path) -> None:
    outlet = DiskQueue(tmp_path / "q", max_bytes=10**6, convert=convert)
    for number in range(4):
        outlet.put(one_set(number))
    seen = [outlet.ahead(number, WAIT) for number in (0, 1, 3)]
    assert [None if frame is None else frame.pts_seconds for frame in seen] == [0.0, 1.0, 3.0]
    assert outlet.ahead(4, 0.0) is None
    assert [taken(outlet) for _ in range(4)] == [0.0, 1.0, 2.0, 3.0]
    assert outlet.status.skipped == 0
    outlet.close()


def test_a_damaged_set_is_none_to_look_at(tmp_path: Path) -> None:
    outlet = DiskQueue(tmp_path / "q", max_bytes=10**6, convert=convert)
    outlet.put(one_set(0))
    assert outlet.ahead(0, WAIT) is not None
    (file,) = (tmp_path / "q").glob("set-*")
    file.write_bytes(file.read_bytes()[:100])
    assert outlet.ahead(0, WAIT) is None
    outlet.close()


def test_the_newest_is_looked_at_ahead_without_a_word_of_its_times() -> None:
    outlet = Latest(convert)
    outlet.put(one_set(1))
    assert outlet.take(0.0) is not None
    times = outlet.taken
    outlet.put(one_set(2))
    frame = outlet.ahead(0, 0.0)
    assert frame is not None
    assert frame.pts_seconds == 2.0
    assert outlet.taken is times
    assert outlet.ahead(1, 0.0) is None


def test_a_full_queue_is_told_once_and_takes_sets_again_when_half_is_done(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    outlet = DiskQueue(tmp_path / "q", max_bytes=20_000, convert=convert)
    with caplog.at_level(logging.WARNING):
        for number in range(30):
            outlet.put(one_set(number))
            while number < 7 and outlet.status.waiting_bytes < (number + 1) * 3_000:
                threading.Event().wait(0.001)
    assert outlet.status.skipped >= 20
    first = [taken(outlet) for _ in range(5)]
    assert first == [0, 1, 2, 3, 4]
    outlet.put(one_set(100))
    rest = []
    while (frame := outlet.take(0.2)) is not None:
        rest.append(frame.pts_seconds)
    assert rest[-1] == 100.0
    assert sum("is full" in record.getMessage() for record in caplog.records) == 1
    outlet.close()


def test_sets_that_come_faster_than_they_are_written_are_skipped(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    held = threading.Event()

    def slowly(found: PictureSet) -> MultiViewFrame:
        held.wait(WAIT)
        return convert(found)

    outlet = DiskQueue(tmp_path / "q", max_bytes=10**6, convert=slowly)
    with caplog.at_level(logging.WARNING):
        for number in range(50):
            outlet.put(one_set(number))
    assert outlet.status.skipped >= 50 - MAX_UNWRITTEN - 1
    assert sum("more slowly than they come" in record.getMessage() for record in caplog.records) == 1
    held.set()
    assert taken(outlet) == 0.0
    outlet.close()


def test_a_full_disk_is_an_error_for_who_takes(tmp_path: Path) -> None:
    def full(found: PictureSet) -> MultiViewFrame:
        raise StorageError("no room")

    outlet = DiskQueue(tmp_path / "q", max_bytes=10**6, convert=full)
    outlet.put(one_set(0))
    with pytest.raises(StorageError, match="no room"):
        outlet.take(WAIT)
    outlet.close()


def test_what_an_earlier_run_left_is_removed(tmp_path: Path) -> None:
    own_folder(tmp_path, PURPOSE)
    others = [tmp_path / name for name in ("set-list.txt", "set-00000099.jpg")]
    for file in (*others, tmp_path / "set-00000099", tmp_path / "set-00000100.partial"):
        file.write_bytes(b"old")
    outlet = DiskQueue(tmp_path, max_bytes=10**6, convert=convert)
    assert sorted(tmp_path.glob("set-*")) == sorted(others)
    outlet.close()
    assert sorted(tmp_path.glob("set-*")) == sorted(others)


def test_a_folder_of_others_is_refused_and_stays(tmp_path: Path) -> None:
    (tmp_path / "set-00000099").write_bytes(b"mine")
    with pytest.raises(StorageError, match="somebody else's"):
        DiskQueue(tmp_path, max_bytes=10**6, convert=convert)
    assert (tmp_path / "set-00000099").read_bytes() == b"mine"


def test_a_set_that_a_power_failure_has_damaged_is_skipped(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    killed = DiskQueue(tmp_path / "q", max_bytes=10**6, convert=convert)
    for number in range(3):
        killed.put(one_set(number))
    while len(list((tmp_path / "q").glob("set-????????"))) < 3:
        time.sleep(0.01)
    (tmp_path / "q" / "set-00000001").write_bytes(b"")
    outlet = DiskQueue(tmp_path / "q", max_bytes=10**6, convert=convert, resume=True)
    assert taken(outlet) == 0.0
    assert outlet.take(WAIT) is None
    assert taken(outlet) == 2.0
    assert (outlet.status.skipped, outlet.status.waiting_bytes) == (1, 0)
    assert caplog.text.count("A set of pictures is lost: The pictures") == 1
    outlet.close()


def test_a_resumed_run_takes_what_waited_when_it_was_killed(tmp_path: Path) -> None:
    killed = DiskQueue(tmp_path / "q", max_bytes=10**6, convert=convert)
    for number in range(5):
        killed.put(one_set(number))
    assert taken(killed) == 0.0
    while len([file for file in (tmp_path / "q").glob("set-*") if not file.suffix]) < 4:  # whole ones
        threading.Event().wait(0.001)
    (tmp_path / "q" / "set-00000005.partial").write_bytes(b"half")
    again = DiskQueue(tmp_path / "q", max_bytes=10**6, convert=convert, resume=True)
    again.put(one_set(9))
    assert [taken(again) for _ in range(5)] == [1, 2, 3, 4, 9]
    assert again.status.waiting_bytes == 0
    again.close()
    killed.close()
