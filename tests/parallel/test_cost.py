# SPDX-License-Identifier: Apache-2.0
"""The model against runs that are reckoned by hand, what must hold for all, and costs from notes and logs."""

from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from structgstream.errors import ConfigError
from structgstream.executors.tasks import TaskResult
from structgstream.parallel.cost import (
    Costs,
    Work,
    estimate,
    measured_in,
    sequential_seconds,
    serial_seconds,
    stream_bytes,
    workers_for,
)
from structgstream.parallel.parts import Parts, group_name
from tests.support.measured_runs import finished_run
from tests.support.properties import examples

COSTS = Costs(
    header_seconds=100.0,
    track_start_seconds=5.0,
    track_seconds=0.5,
    process_seconds=4.0,
    first_seconds=6.0,
    frame_seconds=4.0,
    join_start_seconds=2.0,
    join_seconds=0.01,
    header_bytes=1000.0,
    first_bytes=50.0,
    key_bytes=40.0,
    frame_bytes=10.0,
    worker_bytes=1e9,
)
WORK = Work(frames=60, group=20, key_interval=10)


def test_one_worker_does_all_in_turn() -> None:
    """Frame 0, then the track, then 4 + 19 * 4, 4 + 6 + 20 * 4 twice, then joining."""
    found = estimate(COSTS, WORK, 1)
    assert found.seconds == pytest.approx(100 + (5 + 30) + 80 + 90 + 90 + 2.6)
    assert found.tail_seconds == pytest.approx(80 + 90 + 90)
    assert (found.header_seconds, found.join_seconds) == (100.0, pytest.approx(2.6))


def test_groups_begin_while_others_are_tracked() -> None:
    """The second worker does the first group at once; the third begins when the track has come to frame 40."""
    found = estimate(COSTS, WORK, 4)
    assert found.seconds == pytest.approx(100 + (5 + 41 * 0.5) + 90 + 2.6)
    assert found.speedup == pytest.approx((100 + 59 * 4) / found.seconds)
    assert found.efficiency == pytest.approx(found.speedup / 4)


def test_alone_is_frame_after_frame() -> None:
    assert sequential_seconds(COSTS, WORK) == 100 + 59 * 4
    assert serial_seconds(COSTS, WORK) == pytest.approx(100 + 35 + 2.6)


def test_bytes_are_those_of_packets_by_their_kind() -> None:
    """Two groups of 20 after the first: a key packet each at the beginning, one in the middle of all three."""
    assert stream_bytes(COSTS, WORK) == 1000 + 2 * 50 + 3 * 40 + 3 * 18 * 10


@examples(100)
@given(st.integers(1, 200), st.integers(1, 50), st.integers(1, 20), st.floats(0.0, 10.0))
def test_more_workers_are_never_slower_and_never_faster_than_the_serial_part(
    frames: int, group: int, workers: int, tracking: float
) -> None:
    costs, work = replace(COSTS, track_seconds=tracking), Work(frames, group, 10)
    fewer, more = estimate(costs, work, workers), estimate(costs, work, workers + 1)
    assert more.seconds <= fewer.seconds + 1e-6
    assert more.seconds >= serial_seconds(costs, work) - 1e-6
    assert sum(work.groups) == frames


@examples(60)
@given(st.floats(100.0, 2000.0))
def test_the_workers_for_a_finish_are_the_least_that_end_in_time(seconds: float) -> None:
    found, work = workers_for(COSTS, WORK, seconds), WORK
    if found is None:
        assert estimate(COSTS, work, 100).seconds > seconds
    else:
        assert found.seconds <= seconds
        assert found.workers == 1 or estimate(COSTS, work, found.workers - 1).seconds > seconds


def test_nothing_less_than_one_is_planned() -> None:
    with pytest.raises(ConfigError, match="group must be 1 or more, got 0"):
        Work(10, 0, 10)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return finished_run(tmp_path)


def test_costs_are_those_that_went_in(folder: Path) -> None:
    found = measured_in(folder)
    costs = found.costs
    assert (found.frames, found.groups) == (12, 2)
    assert (costs.header_seconds, costs.track_start_seconds, costs.frame_seconds) == (30.0, 3.0, 2.0)
    assert costs.track_seconds == pytest.approx(0.5)
    assert (costs.process_seconds, costs.first_seconds) == (3.0, pytest.approx(7.0))
    assert (costs.join_start_seconds, costs.join_seconds) == (3.0, pytest.approx(0.1))
    assert (costs.header_bytes, costs.first_bytes, costs.frame_bytes) == (1000, 50, 10)
    assert costs.key_bytes == 50
    assert costs.worker_bytes == 7000


def test_a_group_that_was_killed_is_not_measured(folder: Path) -> None:
    parts = Parts(folder)
    parts.segment(4, 8).write_bytes(b"again")
    parts.record(TaskResult(group_name(4, 8), 0, 1.0, attempts=2), "", parts.segment(4, 8), frames=4)
    assert measured_in(folder).groups == 1


def test_a_run_that_is_not_finished_is_reported(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no finished parallel run"):
        measured_in(tmp_path / "nothing")
    lines = (folder / "done.jsonl").read_text().splitlines(keepends=True)
    (folder / "done.jsonl").write_text("".join(line for line in lines if "000008" not in line))
    with pytest.raises(ConfigError, match="no finished parallel run"):
        measured_in(folder)
