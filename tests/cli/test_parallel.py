# SPDX-License-Identifier: Apache-2.0
"""``parallel`` and ``plan`` on the bundled clip, what they say when something is wrong, and the picture of groups."""

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from rich.console import Console

from backends import QUICKEST
from small_presets import few_points
from structgstream.cli import main
from structgstream.cli.parallel_display import ParallelDisplay, cells, counted
from structgstream.codec.reader import open_stream
from structgstream.data.clip import bundled_clip_path
from structgstream.parallel.driver import State, Status

CLIP = str(bundled_clip_path())
QUICK = ["--preset", "tiny", "--device", QUICKEST, "--scale", "0.25", "--initial.iterations", "3"]
QUICK += ["--online.iterations", "2", "--online.patching.iteration", "1"]
GROUPS = ["--frames", "5", "--groups", "2", "--odd", "--executor", "inline"]


@pytest.fixture(scope="module", autouse=True)
def quick_presets() -> Iterator[None]:
    with few_points("tiny"):
        yield


@pytest.fixture(scope="module")
def stream(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Five frames in groups of two, hardly trained."""
    path = tmp_path_factory.mktemp("parallel") / "clip.sgs"
    assert main(["parallel", CLIP, "-o", str(path), *GROUPS, *QUICK]) == 0
    return path


def error_of(arguments: list[str], capsys: pytest.CaptureFixture[str], *, status: int) -> str:
    capsys.readouterr()
    assert main(arguments) == status
    error = capsys.readouterr().err
    assert "Traceback" not in error
    return error


def test_the_result_is_an_ordinary_stream(stream: Path) -> None:
    with open_stream(stream) as reader:
        assert len(reader) == 5
    parts = stream.with_name("clip.sgs.parts")
    assert sorted(path.name for path in (parts / "segments").glob("*.sgs")) == [
        "group-000000-000002.sgs",
        "group-000002-000004.sgs",
        "group-000004-000005.sgs",
    ]


def test_again_it_says_so_and_makes_nothing(stream: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = {path: path.stat().st_mtime_ns for path in stream.parent.rglob("*0*.sgs")}
    capsys.readouterr()
    assert main(["parallel", CLIP, "-o", str(stream), *GROUPS, *QUICK]) == 0
    assert "groups: 3 of 3 groups done" in capsys.readouterr().out
    assert {path: path.stat().st_mtime_ns for path in stream.parent.rglob("*0*.sgs")} == before


def test_plan_reads_a_run(stream: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    parts, path = str(stream.with_name("clip.sgs.parts")), tmp_path / "plan.json"
    capsys.readouterr()
    words = ["--run", parts, "--length", "3000", "--machines", "1", "8", "--finish-hours", "1000", "--json", str(path)]
    assert main(["plan", CLIP, "--preset", "tiny", *words]) == 0
    text = capsys.readouterr().out
    assert "3000 frames (100.0 s of film) in 100 groups of 30." in text
    assert "Within 1000 h: 1 workers" in text
    assert "Assumed:" in text
    facts = json.loads(path.read_text())
    one, eight = facts["estimates"]
    assert eight["seconds"] < one["seconds"]
    assert facts["measured"]["frames"] == 5


@pytest.mark.parametrize(
    ("words", "status", "said"),
    [
        (["--groups", "0"], 2, "--groups counts frames, from 1; got 0."),
        (["--address", "head:1"], 2, "--address is the head of a Ray cluster; add --executor ray."),
        (["--workers", "0"], 2, "The number of workers must be 1 or more, got 0."),
        (["--preset", "tny"], 2, "there is no preset 'tny'"),
        (["--online.iteration", "5"], 2, "--online.iterations"),
        (
            ["--groups", "7", "--frames", "8", "--executor", "inline", *QUICK],
            1,
            "Groups of 7 frames cost a key packet each",
        ),
    ],
)
def test_wrong_options_are_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], words: list[str], status: int, said: str
) -> None:
    assert said in error_of(["parallel", CLIP, "-o", str(tmp_path / "out.sgs"), *words], capsys, status=status)
    assert not (tmp_path / "out.sgs").exists()


def test_an_output_that_is_no_parallel_run_is_not_replaced(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "out.sgs").write_bytes(b"mine")
    assert "exists; replace it with --overwrite" in error_of(
        ["parallel", CLIP, "-o", str(tmp_path / "out.sgs"), *GROUPS], capsys, status=1
    )
    assert (tmp_path / "out.sgs").read_bytes() == b"mine"


@pytest.mark.parametrize("words", [[], ["-o", "probe", "--run", "parts"]])
def test_plan_wants_a_probe_or_a_run(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert "give either -o FOLDER for a probe, or --run" in error_of(["plan", CLIP, *words], capsys, status=2)


def test_plan_says_that_a_run_is_not_there(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "has no finished parallel run" in error_of(["plan", CLIP, "--run", str(tmp_path)], capsys, status=1)


STATUS = Status(
    "groups",
    [(0, 30), (30, 60), (60, 90), (90, 100)],
    (State.DONE, State.RUNNING, State.READY, State.TRACKED_LATER),
    tracked=3,
)


def test_each_group_has_a_sign_and_many_share_one_that_shows_the_least_done() -> None:
    assert cells(STATUS.states, width=40).plain == "●◐○·"
    assert cells((State.DONE,) * 500, width=10).plain.replace("\n", "") == "●" * 56
    several = [State.DONE] * 120
    several[7] = State.FAILED
    assert cells(several, width=10).plain.replace("\n", "") == "●●●✗" + "●" * 56


def test_the_state_in_words() -> None:
    assert counted(STATUS) == "1 of 4 groups done (30 of 100 frames), 1 running, 1 ready, 1 waiting for the track"
    assert counted(Status("header")) == "frame 0"
    assert counted(replace(STATUS, stage="join")) == "joining, 1 of 4 groups done (30 of 100 frames)"


def test_off_a_terminal_a_line_is_printed_when_something_has_ended(capsys: pytest.CaptureFixture[str]) -> None:
    with ParallelDisplay(Console(width=80), lambda first, end: 7) as display:
        for status in (Status("header"), STATUS, STATUS, replace(STATUS, failed=("group-000030-000060",))):
            display.show(status)
    assert capsys.readouterr().out.splitlines() == [
        "header",
        "groups: 1 of 4 groups done",
        "groups: 1 of 4 groups done, failed: group-000030-000060",
    ]


def test_on_a_terminal_running_groups_show_their_frames() -> None:
    console = Console(width=80, force_terminal=True, record=True)
    with ParallelDisplay(console, lambda first, end: 7) as display:
        display.show(STATUS)
    text = console.export_text()
    assert "frames 30:60  7 of 30" in text
