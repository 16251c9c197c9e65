# SPDX-License-Identifier: Apache-2.0
"""Preparation without what takes most of its time, for tests that look at something else, and who listens to it."""

from functools import partial
from pathlib import Path

import pytest

from structgstream.data.roving import frame_points
from structgstream.preparation import prepare as capture_steps
from structgstream.preparation import report as page
from tests.support.small_presets import FEW_POINTS


def quicken(monkeypatch: pytest.MonkeyPatch) -> None:
    """One coarse sweep for initial points, and empty files for the pictures of reports.

    What is left out: tests/data/test_points.py and tests/preparation/report.
    """
    monkeypatch.setattr(capture_steps, "frame_points", partial(frame_points, config=FEW_POINTS))
    for name in ("draw_overlay", "draw_epipolar", "draw_matrix", "draw_coverage", "draw_times", "draw_colors"):
        monkeypatch.setattr(page, name, _nothing_drawn)


def _nothing_drawn(path: Path, *_: object, **__: object) -> None:
    path.touch()


class Heard:
    """A listener that records all calls."""

    def __init__(self) -> None:
        self.calls: list[tuple[object, ...]] = []

    def begin(self, step: str, *, skipped: bool) -> None:
        self.calls.append(("begin", step, skipped))

    def progress(self, done: int, total: int, what: str) -> None:
        self.calls.append(("progress", done, total, what))

    def end(self, step: str, summary: str) -> None:
        self.calls.append(("end", step, summary))
