# SPDX-License-Identifier: Apache-2.0
"""The picture of groups, and the lines off a terminal."""

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from structgstream.cli.parallel import ROWS, SHOWN, ParallelDisplay, cells, counted
from structgstream.parallel.driver import State, Status

STATUS = Status(
    "groups",
    [(0, 30), (30, 60), (60, 90), (90, 100)],
    (State.DONE, State.RUNNING, State.READY, State.UNTRACKED),
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
