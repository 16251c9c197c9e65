# SPDX-License-Identifier: Apache-2.0
"""Costs of a run whose notes and logs are made by hand."""

import json
from pathlib import Path

import pytest

from structgstream.errors import ConfigError
from structgstream.executors.task import Ending
from structgstream.parallel.measured import measured_in
from structgstream.parallel.parts import Parts, group_name

GROUPS = [(0, 4), (4, 8), (8, 12)]


def entry(index: int, seconds: float, size: int, kind: str) -> str:
    return json.dumps({"index": index, "total_seconds": seconds, "bytes": size, "kind": kind}) + "\n"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Every process takes 3 s, a first frame 9 s, another 2 s."""
    parts = Parts(tmp_path / "parts")
    with parts.held():
        parts.track.with_name("track.sgt.groups").write_text("".join(f"{a}:{b}\n" for a, b in GROUPS))
        parts.header.write_bytes(bytes(1000))
        parts.track.write_bytes(b"track")
        parts.note(Ending("header", 0, 30.0), "", parts.header, frames=1)
        parts.note(Ending("track", 0, 3.0 + 11 * 0.5), "", parts.track, frames=12)
        for a, b in GROUPS:
            segment = parts.segment(a, b)
            segment.write_bytes(b"segment")
            frames = [entry(i, 2.0, 10, "delta") for i in range(a + 1, b)]
            first = [] if not a else [entry(a, 9.0, 50, "key")]
            segment.with_suffix(".log.jsonl").write_text("".join([*first, *frames]))
            seconds = 3.0 + 2.0 * (b - a - 1) + (9.0 if a else 0.0)
            parts.note(Ending(group_name(a, b), 0, seconds, 1, 7000), "", segment, frames=b - a)
        parts.note(Ending("join", 0, 4.2), "", parts.header, frames=12)
    return parts.folder


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
    parts.note(Ending(group_name(4, 8), 0, 1.0, attempts=2), "", parts.segment(4, 8), frames=4)
    assert measured_in(folder).groups == 1


def test_a_run_that_is_not_finished_is_told(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no finished parallel run"):
        measured_in(tmp_path / "nothing")
    lines = (folder / "done.jsonl").read_text().splitlines(keepends=True)
    (folder / "done.jsonl").write_text("".join(line for line in lines if "000008" not in line))
    with pytest.raises(ConfigError, match="no finished parallel run"):
        measured_in(folder)
