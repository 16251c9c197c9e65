# SPDX-License-Identifier: Apache-2.0
"""Display of a parallel run: a cell for each group on a terminal, a line for each result elsewhere."""

import time
from collections import Counter
from collections.abc import Callable, Sequence
from types import TracebackType
from typing import TYPE_CHECKING

from rich.console import Console
from rich.live import Live
from rich.text import Text

from structgstream.cli.progress import print_lines

if TYPE_CHECKING:
    from structgstream.parallel.driver import State, Status

STYLES = {
    "waiting for the track": ("·", "dim"),
    "ready": ("○", ""),
    "running": ("◐", "cyan"),
    "done": ("●", "green"),
    "failed": ("✗", "red"),
}
WORST_FIRST = ("failed", "running", "ready", "waiting for the track", "done")
OTHERS = ("running", "ready", "waiting for the track", "failed")
ROWS = 6
SHOWN = 8
FramesOf = Callable[[int, int], int]
"""Number of fitted frames of a running group."""


def cells(states: Sequence["State"], *, width: int) -> Text:
    """A sign per group; of many groups, one for several, which shows the least advanced state."""
    share = max(1, -(-len(states) // (width * ROWS)))
    text = Text()
    for start in range(0, len(states), share):
        several = states[start : start + share]
        state = next(name for name in WORST_FIRST if name in several)
        sign, style = STYLES[state]
        text.append(sign, style)
        if (start // share + 1) % width == 0:
            text.append("\n")
    return text


def counted(status: "Status") -> str:
    """The status as text."""
    if not status.groups:
        return {"header": "frame 0", "track": "tracking begins"}.get(status.stage, status.stage)
    counts = Counter(str(state) for state in status.states)
    frames = sum(end - first for (first, end), state in zip(status.groups, status.states) if state == "done")
    parts = [f"{counts['done']} of {len(status.groups)} groups done ({frames} of {status.groups[-1][1]} frames)"]
    parts += [f"{counts[name]} {name}" for name in OTHERS if counts[name]]
    return ", ".join(["joining", *parts[:1]] if status.stage == "join" else parts)


class ParallelDisplay:
    """Shows the status: all groups, redrawn on a terminal, else lines.

    Args:
        console: where to write.
        frames_of: number of fitted frames of a group.
    """

    def __init__(self, console: Console, frames_of: FramesOf) -> None:
        self._console, self._frames_of = console, frames_of
        self._begun = time.monotonic()
        self._live = Live(Text(), console=console, refresh_per_second=2)
        self._printed = ""

    def __enter__(self) -> "ParallelDisplay":
        if self._console.is_terminal:
            self._live.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._console.is_terminal:
            self._live.stop()

    def show(self, status: "Status") -> None:
        """Redraws the groups on a terminal; elsewhere prints a line if it has changed."""
        if self._console.is_terminal:
            self._live.update(self._picture(status))
            return
        done = sum(state == "done" for state in status.states)
        line = f"{status.stage}: {done} of {len(status.groups)} groups done" if status.groups else status.stage
        line += f", failed: {', '.join(status.failed)}" if status.failed else ""
        if line != self._printed:
            print_lines(self._console, line)
            self._console.file.flush()
            self._printed = line

    def _picture(self, status: "Status") -> Text:
        width = max(10, min(self._console.width - 2, 100))
        seconds = time.monotonic() - self._begun
        text = Text(f"{counted(status)}, {seconds / 60:.0f} min {seconds % 60:.0f} s\n")
        text.append_text(cells(status.states, width=width))
        running = [group for group, state in zip(status.groups, status.states) if state == "running"]
        for first, end in running[:SHOWN]:
            text.append(f"\n  frames {first}:{end}  {self._frames_of(first, end)} of {end - first}")
        if len(running) > SHOWN:
            text.append(f"\n  and {len(running) - SHOWN} more")
        return text
