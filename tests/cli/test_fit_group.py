# SPDX-License-Identifier: Apache-2.0
"""``fit-group``: what it asks for, and says when it ends; the fit itself is ``groups/unit``'s."""

import os
import signal
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from structgstream.cli import main
from structgstream.groups import unit
from structgstream.groups.first_frame import GroupStartConfig
from structgstream.training.result import Step
from tests.support.quick_streams import CLIP, error_of
from tests.support.reports import frame_report
from tests.support.streams import small_stream


@pytest.fixture
def words(tmp_path: Path) -> list[str]:
    (tmp_path / "header.sgs").write_bytes(small_stream(1))
    return ["fit-group", CLIP, "--init", str(tmp_path / "header.sgs"), "-o", str(tmp_path / "g.sgs")]


def fits(monkeypatch: pytest.MonkeyPatch, *, done: int, then: object = None) -> list[Any]:
    """A fit of frames 60 to 63, which ``then`` ends after two; returns what it is asked for."""
    asked: list[Any] = []

    def fit(path: Path, task: unit.SegmentTask, backend: object, *, overwrite: bool, on_step: Any) -> Any:
        def reports() -> Iterator[Any]:
            for index in range(done, task.end):
                if then is not None and index == done + 2:
                    if isinstance(then, BaseException):
                        raise then
                    os.kill(os.getpid(), signal.SIGTERM)
                on_step(Step(1, 2, 0.5, 10, 0))
                yield frame_report(index)

        asked.append((path, task, overwrite))
        return SimpleNamespace(done=done, reports=reports())

    monkeypatch.setattr(unit, "fit_segment", fit)
    return asked


def test_what_is_asked_for_is_fitted_and_shown(
    words: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = fits(monkeypatch, done=61)
    given = ["--frames", "60:63", "--track", "t", "--iterations", "9", "--rounds", "2", "--overwrite"]
    assert main([*words, *given, "--device", "cpu"]) == 0
    start = GroupStartConfig(iterations=9, rounds=2)
    task = unit.SegmentTask(Path(CLIP), Path(words[3]), Path("t"), 60, 63, start)
    assert asked == [(Path(words[5]), task, True)]
    *frames, last = capsys.readouterr().out.splitlines()
    assert [line.split("  ")[0] for line in frames] == ["frame 62/63", "frame 63/63"]
    assert last == f"Wrote {words[5]}"


def test_a_finished_segment_is_said_to_be(
    words: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(unit, "fit_segment", lambda *given, **options: None)
    assert main([*words, "--frames", "0:2", "--device", "cpu"]) == 0
    assert capsys.readouterr().out == f"{words[5]} is finished.\n"


@pytest.mark.parametrize(("then", "status"), [(KeyboardInterrupt(), 130), ("SIGTERM", 143)])
def test_interrupted_it_says_what_is_safe(
    words: list[str],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    then: object,
    status: int,
) -> None:
    fits(monkeypatch, done=61, then=then)
    error = error_of([*words, "--frames", "60:66", "--device", "cpu"], capsys, status=status)
    # At SIGTERM the frame that is being fitted is finished.
    safe = 3 if status == 130 else 4
    assert f"{safe} of 6 frames are safe; give the same command to go on." in error


def test_ranges_and_numbers_that_mean_nothing_are_refused(
    words: list[str], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = fits(monkeypatch, done=0)
    for given, said in (
        (["--frames", "4"], "--frames 4: a group is A:B, such as --frames 60:120."),
        (["--frames", "4:x"], "a group is A:B"),
        (["--frames", "-1:4"], ""),
        (["--frames", "4:4"], "--frames 4:4 is empty; B is the frame after the last one."),
        (["--frames", "5:4"], "is empty"),
        (["--frames", "0:4", "--iterations", "0"], "--iterations and --rounds must be at least 1."),
        (["--frames", "0:4", "--rounds", "0"], "--iterations and --rounds must be at least 1."),
    ):
        assert said in error_of([*words, *given], capsys, status=2)
    assert not asked


def test_a_group_without_a_track_and_a_header_that_is_none_are_reported(
    words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "header.sgs").write_bytes(b"A letter to someone.")
    error = error_of([*words, "--frames", "2:4", "--device", "cpu"], capsys, status=1)
    assert "is not a structgstream file" in error
    assert error.count("\n") == 1
    assert not (tmp_path / "g.sgs").exists()
