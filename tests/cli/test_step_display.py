# SPDX-License-Identifier: Apache-2.0
"""What the user sees while a capture is prepared."""

import pytest

from structgstream.cli import progress as module
from structgstream.cli.progress import StepDisplay
from tests.support.consoles import console, text


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
