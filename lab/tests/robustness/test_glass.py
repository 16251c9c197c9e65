# SPDX-License-Identifier: Apache-2.0
"""Stages of frames from what run, manifests and page reported."""

from pathlib import Path
from typing import Any

import pytest

from lab.robustness.glass import parsed
from lab.robustness.glass_frames import STAGES, frames_of
from lab.robustness.glass_report import plot, table


def entry(index: int, *, delay: float) -> dict[str, Any]:
    live = {"arrived_seconds": delay - 0.2, "matched_seconds": delay - 0.1, "delay_seconds": delay}
    return {"index": index, "seconds": {"fit": 2.0, "encode": 0.3, "write": 0.1}, "run": {"live": live}}


def edge(frame: int, filmed: float | None) -> dict[str, Any]:
    return {"frame": frame, "captured_unix_seconds": filmed, "published_unix_seconds": (filmed or 0.0) + 3.0}


EVENTS = [
    ("known", 0, 103.2), ("fetched", 0, 103.3), ("decoded", 0, 103.4), ("drawn", 0, 103.5), ("shown", 0, 103.6),
    ("drawn", 0, 104.0), ("known", 2, 113.2), ("fetched", 2, 113.3), ("decoded", 2, 113.4),
]  # fmt: skip


def test_stages_follow_each_other() -> None:
    edges = {0: edge(0, 100.0), 1: edge(1, 105.0), 2: edge(2, 110.0)}
    found = frames_of([entry(index, delay=0.5) for index in range(3)], edges, EVENTS)
    first = [found[0][stage] for stage in STAGES]
    assert first == pytest.approx([0.3, 0.4, 0.5, 0.7, 2.7, 3.0, 3.1, 3.2, 3.3, 3.4, 3.5, 3.6])
    # The page heard of frames 1 and 2 at once, and decoded only the second.
    assert (found[1]["known"], found[1]["decoded"], found[1]["shown"]) == (pytest.approx(8.2), None, None)
    assert (found[2]["decoded"], found[2]["drawn"]) == (pytest.approx(3.4), None)


def test_frames_of_which_it_is_not_known_when_they_were_filmed_are_left_out() -> None:
    found = frames_of([entry(0, delay=0.5), entry(1, delay=0.5)], {0: edge(0, None)}, [])
    assert found == []


def test_results_are_shown(tmp_path: Path) -> None:
    edges = {0: edge(0, 100.0), 1: edge(1, 105.0), 2: edge(2, 110.0)}
    frames = frames_of([entry(index, delay=0.5) for index in range(3)], edges, EVENTS)
    memory = [(10.0 + n, 600_000_000) for n in range(200)]
    run = {
        "transport": "http", "frames": frames, "sets": 1234, "errors": [],
        "memory": {"trainer": memory, "server": memory}, "busy_seconds": {"trainer": 9.0, "server": 1.0},
    }  # fmt: skip
    text = table([run])
    assert "| until shown | 3.60, 3.60 |" in text
    assert "| frames written; shown | 3; 1 |" in text
    assert "| seconds from frame to frame | 5.00 |" in text
    plot(run, tmp_path / "run.png")
    assert (tmp_path / "run.png").stat().st_size > 10_000


def test_options_of_the_trainer_come_last() -> None:
    options = parsed(["out", "--minutes", "2", "--", "--preset", "tiny"])
    assert (options.minutes, options.training) == (2.0, ["--preset", "tiny"])
    assert parsed(["out"]).training == []
