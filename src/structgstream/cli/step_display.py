# SPDX-License-Identifier: Apache-2.0
"""What the user sees while a capture is prepared: a bar for the running step, a line for each that is done."""

import time
from contextlib import AbstractContextManager
from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

from structgstream.cli.plain_text import say

WORTH_SAYING_SECONDS = 0.05


class StepDisplay(AbstractContextManager["StepDisplay"]):
    """A listener of steps; bars are shown on a terminal only.

    Args:
        console: where to write.
    """

    def __init__(self, console: Console) -> None:
        self._console = console
        self._bar = Progress(
            TextColumn("{task.description:<12}"),
            BarColumn(bar_width=32),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TextColumn("{task.fields[what]}", style="dim"),
            console=console,
            transient=True,
            disable=not console.is_terminal,
        )
        self._task: TaskID | None = None
        self._step, self._skipped, self._began = "", False, 0.0

    def __enter__(self) -> "StepDisplay":
        self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bar.stop()

    def begin(self, step: str, *, skipped: bool) -> None:
        """Shows the running step."""
        self._step, self._skipped, self._began = step, skipped, time.monotonic()
        if self._task is not None:
            self._bar.remove_task(self._task)
        self._task = None if skipped else self._bar.add_task(step, total=None, what="")

    def progress(self, done: int, total: int, what: str) -> None:
        """Moves its bar."""
        if self._task is not None:
            self._bar.update(self._task, completed=done, total=total, what=what)

    def end(self, step: str, summary: str) -> None:
        """Prints the line of a step."""
        seconds = time.monotonic() - self._began
        took = "  as before" if self._skipped else f"  {seconds:.1f} s" if seconds > WORTH_SAYING_SECONDS else ""
        say(self._console, f"{step:<12} {summary}{took}")
        if self._task is not None:
            self._bar.remove_task(self._task)
        self._task = None


def step_display(console: Console) -> StepDisplay:
    """The display of a preparation on ``console``."""
    return StepDisplay(console)
