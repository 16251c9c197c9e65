# SPDX-License-Identifier: Apache-2.0
"""``structgstream fit-group``."""

import logging
import re
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro
from rich.console import Console

from structgstream.cli.app import Interrupted, UsageError
from structgstream.cli.options import Device, Flag, Folder, StreamFile, check_ending, parse_options
from structgstream.cli.progress import display, print_lines
from structgstream.cli.signals import Terminated, Termination

if TYPE_CHECKING:
    from structgstream.groups.unit import SegmentTask


@dataclass(frozen=True)
class FitGroup:
    """Fits one group of frames from a header and a track into a segment (docs/cluster.md).

    Configuration, picture size, first frame and held-out cameras are the header's. The same command may be given at any
    time: it resumes after interruption, repairs what is damaged, and does not change a finished segment.

    Example: structgstream fit-group basketball --init header.sgs --track ball.track --frames 60:120 -o g60.sgs
    """

    scene: tyro.conf.Positional[Folder]
    """The capture that the header was made from."""
    init: Annotated[StreamFile, tyro.conf.arg(metavar="HEADER.sgs")]
    """A stream whose header and frame 0 the groups share."""
    frames: Annotated[str, tyro.conf.arg(metavar="A:B")]
    """The group: frames A to B - 1, counted from the header's first."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="SEGMENT")]
    """The segment to write."""
    track: Annotated[Path | None, tyro.conf.arg(metavar="TRACK", help_behavior_hint="")] = None
    """The track of the capture; may be left out for A = 0 only."""
    iterations: Annotated[int | None, tyro.conf.arg(metavar="N", help_behavior_hint="")] = None
    """Optimisation steps of the group's first frame. Default: eleven times those of an online frame."""
    rounds: int = 3
    """Rounds of scene flow, spawning and iterations of the group's first frame."""
    device: Device = "auto"
    """Compute back-end."""
    overwrite: Flag = False
    """Replace SEGMENT when it exists."""


def main(arguments: list[str]) -> None:
    """Fits with a progress display."""
    options = parse_options(FitGroup, "fit-group", arguments=arguments)
    check_ending(options.output, ".sgs", command="fit-group")
    matched = re.fullmatch(r"(\d+):(\d+)", options.frames)
    if matched is None:
        raise UsageError(f"--frames {options.frames}: a group is A:B, such as --frames 60:120.")
    if (options.iterations is not None and options.iterations < 1) or options.rounds < 1:
        raise UsageError("--iterations and --rounds must be at least 1.")
    first, end = int(matched[1]), int(matched[2])
    if first >= end:
        raise UsageError(f"--frames {options.frames} is empty; B is the frame after the last one.")
    from structgstream.groups.first_frame import GroupStartConfig
    from structgstream.groups.unit import SegmentTask

    logging.basicConfig(format="structgstream: %(message)s")  # warnings between progress lines
    start = GroupStartConfig(iterations=options.iterations, rounds=options.rounds)
    task = SegmentTask(options.scene, options.init, options.track, first, end, start)
    written = _fit(options, task)
    text = f"Wrote {options.output}" if written else f"{options.output} is finished."
    print_lines(Console(), text)


def _fit(options: FitGroup, task: "SegmentTask") -> bool:
    """Fits what is missing of the segment; whether anything was."""
    from structgstream.groups.unit import fit_segment
    from structgstream.kernels.backend import select_backend

    run = fit_segment(
        options.output,
        task,
        select_backend(options.device),
        overwrite=options.overwrite,
        on_step=lambda step: progress.step(step),  # Created below, because it needs the number of existing frames.
    )
    if run is None:
        return False
    done = run.done
    try:
        with Termination() as ending, display(task.end, done=done) as progress, closing(run.reports) as reports:
            for report in reports:
                progress.frame(report)
                done = report.index + 1
                if ending.asked and done != task.end:
                    raise Terminated
    except KeyboardInterrupt as error:
        message = f"{done - task.first} of {task.end - task.first} frames are safe; give the same command to go on."
        raise (Terminated if isinstance(error, Terminated) else Interrupted)(message) from None
    return True
