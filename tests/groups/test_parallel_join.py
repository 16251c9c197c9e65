# SPDX-License-Identifier: Apache-2.0
"""Borders that several processes blend have the bytes of a single process."""

from contextlib import closing
from functools import cache
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from structgstream.errors import ConfigError, TaskError
from structgstream.executors.tasks import PYTHON, Task
from structgstream.groups import join, seam_blend
from structgstream.groups.base import GroupBase, open_for
from structgstream.groups.join import MAX_GROUPS, join_segments, runs_of
from structgstream.groups.seam_blend import FADE_FRAMES, OWN_FRAMES, Border
from structgstream.groups.track_pass import track_capture
from tests.support.backends import quickest_backend
from tests.support.clip_groups import CAPTURE, OPTIONS, Made, fit, made, task
from tests.support.inline_engine import InlineEngine
from tests.support.shared_folder import made_once

LONG = OWN_FRAMES - FADE_FRAMES + 1
"""What :data:`OWN_FRAMES` is where differences fade in one frame."""
FRAMES = LONG + 4
BORDERS = (2, 2 + LONG)
RANGES = [(0, BORDERS[0]), (BORDERS[0], BORDERS[1]), (BORDERS[1], FRAMES)]


@cache
def long_groups() -> list[Path]:
    """Groups of 2, of :data:`LONG` and of 2 frames, so that the last border needs nothing of the first."""
    folder = made_once("long-groups", _make_long_groups)
    return [folder / f"{first}.sgs" for first, _ in RANGES]


def _make_long_groups(folder: Path) -> None:
    header, path = made().header, folder / "track"
    base = GroupBase.read(header)
    source = open_for(base.header, CAPTURE, frames=FRAMES)
    with closing(track_capture(path, source, base, OPTIONS, quickest_backend())) as frames:
        assert sum(1 for _ in frames) > 0
    of_track = Made(header, path, [])
    for first, end in RANGES:
        fit(folder / f"{first}.sgs", task(of_track, first, end=end), stop_after=FRAMES)


@pytest.fixture
def fading_in_one_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(seam_blend, "FADE_FRAMES", 1)
    monkeypatch.setattr(join, "OWN_FRAMES", LONG)


@pytest.mark.usefixtures("fading_in_one_frame")
def test_workers_give_the_bytes_of_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(join, "LocalEngine", lambda slots: InlineEngine())
    found = []
    for workers in (1, 2):
        path, borders = tmp_path / f"{workers}.sgs", list[Border]()
        backend = quickest_backend()
        count = join_segments(long_groups(), path, backend=backend, workers=workers, on_border=borders.append)
        assert count == FRAMES
        assert [border.frame for border in borders] == [*BORDERS]
        assert borders[0].blended > 0
        found.append((path.read_bytes(), borders))
    assert found[1] == found[0]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["1.sgs", "2.sgs"]


@pytest.mark.usefixtures("fading_in_one_frame")
def test_a_worker_that_fails_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def failing(paths: list[Path], output: Path, *, device: str) -> Task:
        return Task(output.name, (PYTHON, "-c", "raise SystemExit('no room')"), str(output))

    monkeypatch.setattr(join, "run_task", failing)
    with pytest.raises(TaskError, match="no room"):
        join_segments(long_groups(), tmp_path / "a.sgs", backend=quickest_backend(), workers=2)
    assert not [*tmp_path.iterdir()]


def test_no_worker_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="0 workers"):
        join_segments(made().segments, tmp_path / "a.sgs", backend=quickest_backend(), workers=0)


@given(st.lists(st.integers(1, 2 * OWN_FRAMES), min_size=1, max_size=60), st.integers(1, 9))
def test_runs_have_every_group_but_the_first_once_and_begin_after_long_ones(lengths: list[int], workers: int) -> None:
    runs = runs_of(lengths, workers=workers)
    assert [number for run in runs for number in run] == [*range(1, len(lengths))]
    assert all(lengths[run.start - 1] >= OWN_FRAMES for run in runs[1:])
    if min(lengths) >= OWN_FRAMES:
        assert max(map(len, runs), default=0) <= MAX_GROUPS
        assert len(runs) >= min(workers, len(lengths) - 1) // 2
