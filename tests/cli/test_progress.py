# SPDX-License-Identifier: Apache-2.0
"""What is shown of progress: sentences as they are, frames, steps and groups, in lines or on a terminal."""

import io
import math
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from structgstream.cli import progress
from structgstream.cli import progress as module
from structgstream.cli.parallel import ROWS, SHOWN, ParallelDisplay, cells, counted
from structgstream.cli.progress import StepDisplay, display, human_bytes, literal_cells, print_lines, printable, summary
from structgstream.parallel.driver import State, Status
from structgstream.training.result import Step
from tests.support.consoles import console, text
from tests.support.reports import frame_report


def test_names_with_brackets_and_long_paths_stay_as_they_are() -> None:
    written = io.StringIO()
    path = "take [red] 2/" + "folder/" * 40 + "out.sgs"
    print_lines(Console(file=written, width=40, force_terminal=True), f"Wrote {path}: 12.5 MB", "and more")
    assert written.getvalue() == f"Wrote {path}: 12.5 MB\nand more\n"


def test_what_a_terminal_would_obey_is_shown_as_escapes(capsys: pytest.CaptureFixture[str]) -> None:
    assert printable("caf\u00e9 \u4e2d\n\tend") == "caf\u00e9 \u4e2d\n\tend"
    assert printable("a\x1b]0;mine\x07\ud800\u202e") == r"a\x1b]0;mine\x07\ud800\u202e"
    print_lines(Console(), "name \x1b[31m \ud800")
    assert capsys.readouterr().out == "name \\x1b[31m \\ud800\n"
    assert [cell.plain for cell in literal_cells("\x1b[2J")] == [r"\x1b[2J"]


REPORT = frame_report(
    1,
    bytes=812_345,
    train_psnr=31.204,
    anchors=34_512,
    moving=34_512,
    free=2_301,
    spawned=5,
    pruned=1,
    seconds={"total": 5.12},
)


def test_a_line_for_each_frame() -> None:
    out = console(terminal=False)
    with display(20, done=1, console=out) as shown:
        shown.step(Step(1, 100, 0.5, 34_512, 0))
        shown.frame(REPORT)
    assert text(out) == "frame  2/20  train 31.20 dB   812.3 kB     5.1 s  34,512 anchors  2,301 free (+5 -1)\n"


@pytest.mark.parametrize(
    ("known", "said"),
    [
        ({"train_psnr": math.nan}, "frame  2/20  train     - dB "),
        ({"moving": 5_001}, "  34,512 anchors (5,001 moving)  2,301 free"),
        ({"index": 0, "grown": 1_812, "removed": 40}, "  34,512 anchors (+1,812 -40)  2,301 free"),
        (
            {"counts": {"displaced": 40, "views left out": 2, "scene cuts": 0, "spawning refused": 1}},
            "  [2 views left out: only their pictures changed, or theirs did not]  [no births",
        ),
        ({"counts": {"held": 1, "scene cuts": 1}}, "[fewer than two pictures show anything: the scene is held]"),
    ],
)
def test_a_line_tells_what_is_unusual(known: dict[str, Any], said: str) -> None:
    assert said in summary(replace(REPORT, **known), 20)
    assert summary(replace(REPORT, counts={"displaced": 40, "views left out": 0}), 20) == summary(REPORT, 20)


def test_a_long_frame_speaks_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(progress, "QUIET_SECONDS", -1.0)
    out = console(terminal=False)
    with display(20, done=4, console=out) as shown:
        shown.step(Step(7, 100, 0.25, 1_000, 0))
    assert text(out) == "frame 5/20: iteration 7/100, loss 0.2500, 1,000 anchors\n"


def test_bars_show_frames_iterations_and_the_last_frame() -> None:
    out = console(terminal=True)
    with display(20, done=1, console=out) as shown:
        shown.step(Step(40, 100, 0.25, 34_512, 7))
        shown.frame(REPORT)
        shown.step(Step(10, 100, 0.25, 34_512, 7))
    final = text(out).splitlines()
    assert any("frames" in line and " 2/20" in line and "5.1 s a frame" in line for line in final)
    assert "frame  2/20  train 31.20 dB" in text(out).splitlines()[-2]


@pytest.mark.parametrize(
    ("count", "words"),
    [(0, "0 B"), (999, "999 B"), (1000, "1.0 kB"), (999_400, "999.4 kB"), (999_600, "1.0 MB"), (3.2e9, "3.20 GB")],
)
def test_bytes_for_reading(count: float, words: str) -> None:
    assert human_bytes(count) == words


def test_several_qualities_of_a_frame_are_distinguished() -> None:
    for terminal in (False, True):
        out = console(terminal=terminal)
        with display(20, done=1, console=out) as shown:
            for quality in ("low", "high"):
                shown.step(Step(1, 100, 0.5, 34_512, 0))
                shown.frame(REPORT, quality=quality)
        assert "frame  2/20  high  train 31.20 dB" in text(out)


class Clock:
    """Seconds that a test moves."""

    seconds = 0.0


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    found = Clock()
    monkeypatch.setattr(module.time, "monotonic", lambda: found.seconds)
    return found


def test_a_line_for_each_step_with_its_time(clock: Clock) -> None:
    to = console()
    with StepDisplay(to) as display:
        for step, skipped, seconds, summary in (
            ("find", False, 0.01, "5 videos"),
            ("calibrate", False, 12.34, "sfm: [5] cameras"),
            ("points", True, 0.2, "900 points"),
        ):
            display.begin(step, skipped=skipped)
            display.progress(1, 2, "cam0")
            clock.seconds += seconds
            display.end(step, summary)
    assert text(to).splitlines() == [
        "find         5 videos",
        "calibrate    sfm: [5] cameras  12.3 s",
        "points       900 points  as before",
    ]


def test_a_terminal_shows_the_running_step_and_what_it_is_at() -> None:
    to = console(terminal=True)
    with StepDisplay(to) as display:
        display.begin("calibrate", skipped=False)
        display.progress(3, 8, "cam07")
        display._bar.refresh()
        shown = text(to)
        assert "calibrate" in shown
        assert "3/8" in shown
        assert "cam07" in shown
        display.end("calibrate", "done")
        assert not display._bar.tasks
        display.progress(4, 8, "cam08")  # nobody's: the step has ended
    assert "calibrate    done" in text(to)


def test_a_step_that_is_skipped_or_begun_anew_has_no_bar_of_the_last() -> None:
    with StepDisplay(console(terminal=True)) as display:
        display.begin("one", skipped=False)
        display.begin("two", skipped=False)
        assert [task.description for task in display._bar.tasks] == ["two"]
        display.begin("three", skipped=True)
        assert not display._bar.tasks


STATUS = Status(
    "groups", [(0, 30), (30, 60), (60, 90), (90, 100)], (State.DONE, State.RUNNING, State.READY, State.UNTRACKED)
)


def test_each_group_has_a_sign_and_many_share_one_that_shows_the_least_done() -> None:
    assert cells(STATUS.states, width=40).plain == "●◐○·"
    assert cells((State.DONE,) * 500, width=10).plain.replace("\n", "") == "●" * 56
    several = [State.DONE] * 120
    several[7] = State.FAILED
    assert cells(several, width=10).plain.replace("\n", "") == "●●●✗" + "●" * 56


def test_the_state_in_words() -> None:
    assert counted(STATUS) == "1 of 4 groups done (30 of 100 frames), 1 running, 1 ready, 1 waiting for the track"
    assert [counted(Status(stage)) for stage in ("header", "track", "join")] == ["frame 0", "tracking begins", "join"]
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


@given(st.lists(st.sampled_from([*State]), min_size=1, max_size=900), st.integers(10, 100))
def test_any_number_of_groups_fits_and_a_failure_is_always_seen(states: list[State], width: int) -> None:
    lines = cells(states, width=width).plain.splitlines()
    assert len(lines) <= ROWS
    assert all(len(line) <= width for line in lines)
    assert ("✗" in "".join(lines)) == (State.FAILED in states)
    assert ("".join(lines) == "●" * len("".join(lines))) == (set(states) == {State.DONE})


def test_of_many_running_groups_some_are_shown_and_the_rest_counted() -> None:
    groups = [(10 * i, 10 * i + 10) for i in range(SHOWN + 3)]
    console = Console(width=80, force_terminal=True, record=True)
    with ParallelDisplay(console, lambda first, end: first // 10) as display:
        display.show(Status("groups", groups, (State.RUNNING,) * len(groups)))
    text = console.export_text()
    assert "frames 70:80  7 of 10" in text
    assert "frames 80:90" not in text
    assert "and 3 more" in text
