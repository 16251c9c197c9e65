# SPDX-License-Identifier: Apache-2.0
"""Costs of a run are those that went into its notes and logs."""

from pathlib import Path

import pytest

from structgstream.errors import ConfigError
from structgstream.executors.tasks import TaskResult
from structgstream.parallel.cost import measured_in
from structgstream.parallel.parts import Parts, group_name
from tests.support.measured_runs import finished_run


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
