# SPDX-License-Identifier: Apache-2.0
"""What ``ablate`` and ``compare`` share: a sweep with a display, and its tables."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro
from rich.console import Console
from rich.live import Live
from rich.text import Text

from structgstream.cli.app import Interrupted, UsageError
from structgstream.cli.options import CaptureOptions, Device, Folder
from structgstream.cli.progress import compact_table, literal_cells, print_lines
from structgstream.executors.tasks import ExecutorName, ExecutorOptions
from structgstream_studies.errors import ExperimentError

if TYPE_CHECKING:
    from structgstream_studies.experiments.captures import CapturePart
    from structgstream_studies.experiments.sheets import Sheet
    from structgstream_studies.experiments.sweep import Progress
    from structgstream_studies.experiments.worker import Task

NARROW = 4  # columns of scores that fit on a terminal of 80 characters beside the names


@dataclass(frozen=True)
class ExperimentOptions:
    """Options of every experiment."""

    output: Annotated[Path, tyro.conf.arg(metavar="FOLDER", aliases=["-o"])]
    """Folder of streams, results, tables and pictures. Finished runs in it are not repeated."""
    seeds: Annotated[tuple[int, ...], tyro.conf.arg(metavar="N [N ...]", help_behavior_hint="")] = (0, 1, 2)
    """Random seeds; every result is given with its spread over them."""
    jobs: Annotated[int | None, tyro.conf.arg(metavar="N", help_behavior_hint="")] = None
    """Number of parallel runs, each on its share of the cores. Default: one per core, or one per GPU."""
    executor: ExecutorName = "local"
    """What runs them: processes of this machine, or a Ray cluster (docs/cluster.md)."""
    address: Annotated[str | None, tyro.conf.arg(metavar="HOST:PORT", help_behavior_hint="")] = None
    """Head of the Ray cluster, whose machines see the capture and FOLDER at the same place. Default: one begun here."""
    device: Device = "auto"
    """What computes."""
    scored: Annotated[tuple[str, ...] | None, tyro.conf.arg(metavar="CAMERA [CAMERA ...]", help_behavior_hint="")] = (
        None
    )
    """Held-out cameras to score, so that choices and reports can use different ones. Default: all held-out ones."""
    capture: CaptureOptions = field(default_factory=CaptureOptions)


def capture_part(scene: Folder, asked: ExperimentOptions) -> tuple["CapturePart", int]:
    """The part of the capture that the options select, and its number of frames.

    Raises:
        CaptureError: it does not exist.
        UsageError: it has no held-out camera to score.
    """
    from structgstream_studies.experiments.captures import CapturePart

    options = asked.capture
    part = CapturePart(
        folder=scene,
        held_out=options.held_out,
        scale=options.scale,
        start=options.start,
        frames=options.frames,
        near=options.near,
        scored=asked.scored,
        thinned=options.every,
    )
    source = part.open()
    if not source.rig.testing:
        raise UsageError(f"{source.name} holds out no camera to score; name one with --held-out.")
    if unknown := [name for name in asked.scored or () if name not in source.rig.testing]:
        raise UsageError(f"camera {unknown[0]!r} is not held out; held out are {', '.join(source.rig.testing)}.")
    # By name, so that results are found again whatever chose the camera.
    return (part if part.held_out is None else replace(part, held_out=source.rig.testing)), len(source)


def run_sweep(tasks: Sequence["Task"], options: ExperimentOptions) -> None:
    """Runs the unfinished tasks, and reports failures and how to continue.

    Raises:
        ExperimentError: tasks failed; the others are done.
        Interrupted: the user pressed Ctrl-C.
    """
    from structgstream_studies.experiments.sweep import executor_for, gpus_of, sweep

    device, folder = options.device, options.output
    given = ExecutorOptions(options.executor, workers=options.jobs, address=options.address)
    gpus = int(device == "cuda" or gpus_of(device) > 0)
    console = Console()
    view = Display(console)
    try:
        with executor_for(device, given) as executor, view:
            outcome = sweep(tasks, executor, folder=folder, device=device, gpus=gpus, listener=view.show)
    except KeyboardInterrupt:
        raise Interrupted("Whole frames are stored; go on with the same command.") from None
    if outcome.skipped:
        console.print(f"{len(outcome.skipped)} of {len(tasks)} steps were done already.", highlight=False)
    if outcome.failed:
        names = ", ".join(outcome.failed)
        waiting = f", and {len(outcome.blocked)} that needed them were not begun" if outcome.blocked else ""
        raise ExperimentError(
            f"{len(outcome.failed)} of {len(tasks)} steps failed ({names}){waiting}. Why is in "
            f"{folder / 'logs' / (outcome.failed[0] + '.txt')}; the same command goes on with what is left."
        )


class Display:
    """Shows running steps on a terminal, or else a line when each starts or ends."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._live = Live(Text(), console=console, refresh_per_second=2, transient=True)
        self._known: set[str] = set()

    def __enter__(self) -> "Display":
        if self._console.is_terminal:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._console.is_terminal:
            self._live.stop()

    def show(self, progress: "Progress") -> None:
        """Shows the progress."""
        counts = f"{progress.finished} of {progress.total} steps done"
        failed = f", failed: {', '.join(progress.failed)}" if progress.failed else ""
        if self._console.is_terminal:
            lines = [f"  {name}: {done} of {frames} frames" for name, (done, frames) in progress.running.items()]
            self._live.update(Text("\n".join([counts + failed, *lines])))
            return
        for name in sorted(progress.running.keys() - self._known):
            print_lines(self._console, f"{counts}{failed}; begins {name}")
        self._known |= progress.running.keys()


def print_sheet(sheet: "Sheet", console: Console) -> None:
    """The sheet as tables that a terminal is wide enough for, each with the names of the rows."""
    wide = console.width >= 20 * len(sheet.columns)
    step = len(sheet.columns) if wide else NARROW
    for start in range(1, len(sheet.columns), step):
        table = compact_table()
        table.title = Text(sheet.title if start == 1 else f"{sheet.title}, continued")
        shown = [0, *range(start, min(start + step, len(sheet.columns)))]
        for i in shown:
            table.add_column(sheet.columns[i], justify="left" if i == 0 else "right")
        for row in sheet.rows:
            table.add_row(*literal_cells(*(row[i] for i in shown)))
        console.print(table)
        console.print()
