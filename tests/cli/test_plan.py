# SPDX-License-Identifier: Apache-2.0
"""``plan`` from a run whose measurements are known, and with a probe that is not made."""

import json
from pathlib import Path

import pytest

from structgstream.cli import app, main, parallel
from tests.support.measured_runs import finished_run
from tests.support.quick_streams import CLIP, error_of


@pytest.fixture
def parts(tmp_path: Path) -> str:
    return str(finished_run(tmp_path))


def test_plan_reads_a_run(parts: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "plan.json"
    words = ["--run", parts, "--length", "3000", "--machines", "1", "8", "--finish-hours", "1000", "--json", str(path)]
    assert main(["plan", CLIP, "--preset", "tiny", *words]) == 0
    text = capsys.readouterr().out
    assert "3000 frames (100.0 s of film) in 100 groups of 30." in text
    assert "frame 0 30.0 s, tracking 0.50 s a frame, a group 10.0 s and 2.00 s a frame (2 groups)" in text
    assert "Within 1000 h: 1 workers" in text
    assert "0.50 frames a second here, 60.0 times too slow for 30." in text
    assert "Assumed:" in text
    facts = json.loads(path.read_text())
    one, eight = facts["estimates"]
    assert (one["machines"], eight["machines"]) == (1, 8)
    assert eight["seconds"] < one["seconds"]
    assert (facts["measured"]["frames"], facts["measured"]["costs"]["frame_seconds"]) == (12, 2.0)
    assert facts["wanted"]["workers"] == 1


def test_a_finish_that_no_number_reaches_is_said(parts: str, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["--run", parts, "--length", "3000", "--finish-hours", "0.01"]
    assert main(["plan", CLIP, "--preset", "tiny", *words]) == 0
    assert "Within 0.01 h: not possible; least " in capsys.readouterr().out


def test_workers_of_a_machine_count(parts: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    seconds = []
    for machines, workers in (("4", "1"), ("2", "2")):
        path = tmp_path / "plan.json"
        words = ["--run", parts, "--length", "300", "--machines", machines, "--workers", workers, "--json", str(path)]
        assert main(["plan", CLIP, "--preset", "tiny", *words]) == 0
        seconds.append(json.loads(path.read_text())["estimates"][0]["seconds"])
    assert seconds[0] == seconds[1]


@pytest.mark.parametrize("words", [[], ["-o", "probe", "--run", "parts"]])
def test_plan_wants_a_probe_or_a_run(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    error = error_of(["plan", CLIP, *words], capsys, status=2)
    assert "give either -o FOLDER for a probe, or --run" in error


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--workers", "0"], "--machines and --workers count from 1."),
        (["--machines", "4", "0"], "--machines and --workers count from 1."),
        (["--length", "-1"], "-1"),
        (["--groups", "-2"], "-2"),
        (["--preset", "tny"], "there is no preset 'tny'"),
    ],
)
def test_numbers_that_mean_nothing_are_refused(
    parts: str, words: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert said in error_of(["plan", CLIP, "--run", parts, *words], capsys, status=2)


def test_plan_says_that_a_run_is_not_there(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    error = error_of(["plan", CLIP, "--run", str(tmp_path)], capsys, status=1)
    assert "has no finished parallel run" in error
    assert error.count("\n") == 1


def test_a_probe_is_a_short_run_with_the_same_options(
    parts: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    given: list[list[str]] = []
    real = app.main

    def command(words: list[str]) -> int:
        given.append(words)
        (tmp_path / "probe").mkdir()
        Path(parts).rename(tmp_path / "probe" / "probe.sgs.parts")
        return 0

    monkeypatch.setattr(app, "main", command)
    words = ["-o", str(tmp_path / "probe"), "--preset", "tiny", "--held-out", "cam01", "--scale", "0.5"]
    words += ["--every", "2"]
    assert real(["plan", CLIP, *words, "--online.iterations", "9"]) == 0
    capsys.readouterr()
    (asked,) = given
    assert asked[:4] == ["parallel", CLIP, "-o", str(tmp_path / "probe" / "probe.sgs")]
    text = " ".join(asked)
    same = ("--preset tiny", "--held-out cam01", "--scale 0.5", "--every 2")
    for part in (f"--frames {parallel.PROBE_FRAMES}", *same, "--workers 1"):
        assert part in text
    assert text.endswith("--online.iterations 9")


@pytest.mark.parametrize("status", [1, 130])
def test_the_status_of_a_probe_that_fails_is_that_of_plan(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, status: int
) -> None:
    real = app.main
    monkeypatch.setattr(app, "main", lambda words: status)
    assert real(["plan", CLIP, "-o", str(tmp_path / "probe"), "--preset", "tiny"]) == status


def test_a_probe_whose_folder_cannot_be_made_is_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").touch()
    error = error_of(["plan", CLIP, "-o", str(tmp_path / "file" / "probe"), "--preset", "tiny"], capsys, status=1)
    assert "cannot be" in error
    assert "unexpected" not in error
