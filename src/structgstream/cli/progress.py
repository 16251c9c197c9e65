# SPDX-License-Identifier: Apache-2.0
"""What commands print: sentences, tables, and progress of runs and of preparation (bars on a terminal, else lines)."""

import math
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING

from rich.box import SIMPLE_HEAD
from rich.console import Console, Group, OverflowMethod
from rich.live import Live
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Table
from rich.text import Text

if TYPE_CHECKING:
    from structgstream.session.frame_report import FrameReport
    from structgstream.training.result import Step


def printable(text: str) -> str:
    """A text with control characters as escapes, such as ``\\x1b``."""
    return "".join(one if one.isprintable() or one in "\n\t" else ascii(one)[1:-1] for one in text)


def print_lines(console: Console, *lines: str) -> None:
    """Prints lines without rich's markup, colours and line breaks, so that paths can be copied and parsed."""
    for line in lines:
        console.print(printable(line), highlight=False, markup=False, soft_wrap=True)


def frames_text(count: int) -> str:
    """A number of frames as text."""
    return "1 frame" if count == 1 else f"{count} frames"


SHOWN_FRAMES = 24  # of a longer stream evenly spaced frames are shown


def name_value_table() -> Table:
    """A table of names and values without lines."""
    table = Table.grid(padding=(0, 2))
    table.add_column(style="dim")
    table.add_column()
    return table


def literal_cells(*cells: str) -> tuple[Text, ...]:
    """Cells without markup, because names may contain square brackets, and without what a terminal would obey."""
    return tuple(Text(printable(cell)) for cell in cells)


def plain_table(*titles: str, right: Collection[str] = (), overflow: OverflowMethod = "ellipsis") -> Table:
    """A table with columns of these titles, without lines."""
    table = Table(box=None, pad_edge=False)
    for name in titles:
        table.add_column(name, justify="right" if name in right else "left", overflow=overflow)
    return table


def compact_table(*titles: str, left: Collection[str] = (), title: str | Text | None = None) -> Table:
    """A table with columns of these titles, of which ten columns of numbers fit into 80 characters."""
    table = Table(
        title=title, box=SIMPLE_HEAD, header_style="bold", title_justify="left", padding=(0, 1, 0, 0), show_edge=False
    )
    for name in titles:
        table.add_column(name, justify="left" if name in left else "right")
    return table


def counting_bars(
    description: str, *more: ProgressColumn, console: Console, transient: bool = False, disable: bool = False
) -> Progress:
    """Bars of tasks that count, with a ``description`` before and columns of ``more`` behind."""
    columns = (TextColumn(description), BarColumn(bar_width=32), MofNCompleteColumn(), *more)
    return Progress(*columns, console=console, transient=transient, disable=disable)


@contextmanager
def frame_bar(title: str, total: int) -> Iterator[Callable[[], None]]:
    """A bar of ``total`` frames on standard error while the block runs; call what it gives after each frame."""
    with counting_bars(title, TimeRemainingColumn(), console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("frames", total=total)
        yield lambda: bar.advance(task)


MAX_NAMES = 5
QUIET_SECONDS = 15.0  # without a terminal, interval of progress lines within a frame


def display(frames: int | None, *, done: int = 0, console: Console | None = None) -> "Bars | Lines":
    """Bars when ``console`` (default: standard output) is a terminal, else plain lines, of ``frames`` in all if that is
    known."""
    console = Console() if console is None else console
    return Bars(frames, done, console=console) if console.is_terminal else Lines(frames, done, console=console)


def summary(report: "FrameReport", frames: int | None, *, quality: str | None = None) -> str:
    """One frame in one line, of ``frames`` where that is known, and its quality where there are several."""
    number = str(report.index + 1) if frames is None else f"{report.index + 1:>{len(str(frames))}}/{frames}"
    moving = f" ({report.moving:,} moving)" if report.index and report.moving < report.anchors else ""
    # Where nothing moves, nothing is trained.
    psnr = f"{report.train_psnr:5.2f}" if math.isfinite(report.train_psnr) else "    -"
    return (
        f"frame {number}{'' if quality is None else f'  {quality}'}  train {psnr} dB  "
        f"{human_bytes(report.bytes):>9}  {report.seconds['total']:6.1f} s  "
        f"{report.anchors:,} anchors{moving}{change(report.grown, report.removed)}  "
        f"{report.free:,} free{change(report.spawned, report.pruned)}{remarks(report.counts)}{absences(report.absent)}"
        f"{'' if report.begins is None else f'  [new period: {report.begins}]'}"
    )


def change(came: int, went: int) -> str:
    """Numbers of added and removed items, in brackets; empty if both are 0."""
    return f" (+{came:,} -{went:,})" if came or went else ""


REMARKS = {
    "held": "fewer than two pictures show anything: the scene is held",
    "views left out": "{} views left out: only their pictures changed, or theirs did not",
    "scene cuts": "the pictures changed everywhere: motion segmentation skipped",
    "spawning refused": "no births: too many pixels are missing at once",
}


def remarks(counts: Mapping[str, int]) -> str:
    """Remarks on a frame's pictures: outlier views and refused births (``training/online/select.py``)."""
    return "".join(f"  [{text.format(counts[name])}]" for name, text in REMARKS.items() if counts.get(name))


def absences(cameras: Sequence[str]) -> str:
    """A remark on the cameras without a picture of the frame; empty without any."""
    if not cameras:
        return ""
    names = ", ".join(cameras[:MAX_NAMES]) + (", ..." if len(cameras) > MAX_NAMES else "")
    return f"  [absent: {names}]" if len(cameras) == 1 else f"  [{len(cameras)} cameras absent: {names}]"


def human_bytes(count: float) -> str:
    """Bytes for reading, 1 kB = 1000 bytes."""
    for unit in ("B", "kB", "MB"):
        if count < 999.5:
            return f"{count:.0f} {unit}" if unit == "B" else f"{count:.1f} {unit}"
        count /= 1000
    return f"{count:.2f} GB"


class Lines:
    """Plain lines, for files and pipes; each frame's ends with the text of ``further``."""

    def __init__(
        self, frames: int | None, done: int, *, console: Console, further: Callable[[], str] = lambda: ""
    ) -> None:
        self._frames, self._current, self._console, self._further = frames, done, console, further
        self._spoken = time.monotonic()

    def __enter__(self) -> "Lines":
        return self

    def __exit__(self, *raised: object) -> None:
        return None

    def step(self, step: "Step") -> None:
        """Prints a line if the frame takes long."""
        if time.monotonic() - self._spoken > QUIET_SECONDS:
            of = "" if self._frames is None else f"/{self._frames}"
            self._print(
                f"frame {self._current + 1}{of}: iteration {step.iteration}/{step.iterations}, "
                f"loss {step.loss:.4f}, {step.anchors:,} anchors"
            )

    def frame(self, report: "FrameReport", *, quality: str | None = None) -> None:
        """Prints the frame's line."""
        self._current = report.index + 1
        self._print(f"{summary(report, self._frames, quality=quality)}{self._further()}")

    def _print(self, text: str) -> None:
        print_lines(self._console, text)
        self._console.file.flush()
        self._spoken = time.monotonic()


class Bars:
    """A bar of frames, a bar of the running frame's iterations, and the last frame's numbers."""

    def __init__(self, frames: int | None, done: int, *, console: Console) -> None:
        self._frames = frames
        note = TextColumn("{task.fields[note]}", style="dim")
        self._progress = counting_bars(
            "{task.description:<10}", TimeElapsedColumn(), TimeRemainingColumn(), note, console=console
        )
        self._all = self._progress.add_task("frames", total=frames, completed=done, note="")
        self._one = self._progress.add_task(f"frame {done + 1}", total=None, note="preparing")
        self._last = Text("", style="dim")
        self._live = Live(Group(self._progress, self._last), console=console, refresh_per_second=8)

    def __enter__(self) -> "Bars":
        self._live.start()
        return self

    def __exit__(self, *raised: object) -> None:
        self._progress.update(self._one, visible=False)
        self._live.stop()

    def step(self, step: "Step") -> None:
        """Advances the bar of iterations."""
        note = f"loss {step.loss:.4f}  {step.anchors:,} anchors  {step.free:,} free"
        self._progress.update(self._one, completed=step.iteration, total=step.iterations, note=note)

    def frame(self, report: "FrameReport", *, quality: str | None = None) -> None:
        """Advances the bar of frames and resets that of iterations."""
        note = f"{report.seconds['total']:.1f} s a frame" if quality is None else f"{quality} has it"
        following = f"frame {report.index + 2}" if quality is None else "next"
        self._progress.update(self._all, completed=report.index + 1, note=note)
        self._progress.reset(self._one, total=None, description=following, note="")
        self._last.plain = summary(report, self._frames, quality=quality)


MIN_SHOWN_SECONDS = 0.05


class StepDisplay:
    """A listener of steps; bars are shown on a terminal only."""

    def __init__(self, console: Console) -> None:
        self._console = console
        what, off = TextColumn("{task.fields[what]}", style="dim"), not console.is_terminal
        self._bar = counting_bars(
            "{task.description:<12}", TimeElapsedColumn(), what, console=console, transient=True, disable=off
        )
        self._task: TaskID | None = None
        self._step, self._skipped, self._began = "", False, 0.0

    def __enter__(self) -> "StepDisplay":
        self._bar.start()
        return self

    def __exit__(self, *raised: object) -> None:
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
        took = "  as before" if self._skipped else f"  {seconds:.1f} s" if seconds > MIN_SHOWN_SECONDS else ""
        print_lines(self._console, f"{step:<12} {summary}{took}")
        if self._task is not None:
            self._bar.remove_task(self._task)
        self._task = None
