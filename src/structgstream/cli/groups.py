# SPDX-License-Identifier: Apache-2.0
"""Commands of groups of frames that are fitted separately: ``track``, ``fit-group`` and ``join`` (docs/cluster.md)."""

import logging
import re
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro
from rich.console import Console
from rich.progress import TimeElapsedColumn, TimeRemainingColumn

from structgstream.cli.app import StopSignal, UsageError, interruption, usage_errors
from structgstream.cli.options import (
    Device,
    Flag,
    Folder,
    Number,
    StreamFile,
    StreamOutput,
    check_ending,
    check_new,
    parse_options,
    shown_as,
)
from structgstream.cli.progress import counting_bars, display, frames_text, human_bytes, print_lines

if TYPE_CHECKING:
    from structgstream.groups.seam_blend import Border


@dataclass(frozen=True)
class Track:
    """Follows what moves through every frame, so that groups of frames can be fitted separately
    (docs/cluster.md).

    TRACK holds where things are when a group begins, TRACK.groups a line a:b for each group. After Ctrl-C or a kill the
    same command continues; a finished track is not changed.

    Example: structgstream track basketball --init header.sgs -o ball.track --groups 60

    Example: structgstream track basketball --init header.sgs -o ball.track --groups 60 --split-at-low-motion
    """

    scene: tyro.conf.Positional[Folder]
    """The capture that the header was made from."""
    init: Annotated[StreamFile, tyro.conf.arg(metavar="HEADER.sgs")]
    """A stream whose header and frame 0 the groups share: reconstruct --frames 1 --sound none, or any longer stream
    without sound."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="TRACK")]
    """The track to write."""
    groups: Number = None
    """Frames of a group. Default: as many as from one key packet to the next."""
    split_at_low_motion: Flag = False
    """Begin groups where few pixels change, half of N to one and a half times N frames apart."""
    allow_unaligned: Flag = False
    """Allow an N that is no multiple of the interval of key packets; each group then costs one more key packet."""
    frames: Annotated[int | None, shown_as("M")] = None
    """Number of frames. Default: all."""
    after: Annotated[Path | None, shown_as("SEGMENT")] = None
    """Begin at the end of this finished segment, with its fitted positions, which are more exact than tracked ones: for
    the groups after it."""
    cameras: Number = None
    """Largest number of cameras for a frame; of more, every second, third, ... is used, in turn. Default: half of the
    rig, at most 14; all of a rig of 10 or fewer."""
    device: Device = "auto"
    """Compute back-end."""
    overwrite: Flag = False
    """Replace TRACK when it exists."""


def track(arguments: list[str]) -> None:
    """Tracks with a progress bar, and lists the groups."""
    options = parse_options(Track, "track", arguments=arguments)
    check_ending(options.output, command="track")
    from structgstream.atomic_files import remove_unused
    from structgstream.groups.base import GroupBase, open_for
    from structgstream.groups.segment_file import open_segment
    from structgstream.groups.track_file import check_length, groups_path, open_track
    from structgstream.groups.track_pass import TrackOptions, track_capture
    from structgstream.groups.tracking import TrackConfig
    from structgstream.kernels.backend import select_backend

    base = GroupBase.read(options.init)
    length = base.key_interval if options.groups is None else options.groups
    with usage_errors():
        if not options.allow_unaligned or length < 1:
            check_length(length, key_interval=base.key_interval)
    if options.cameras is not None and options.cameras < 2:
        raise UsageError(f"--cameras must be at least 2, got {options.cameras}.")
    source = open_for(base.header, options.scene, frames=options.frames)
    backend = select_backend(options.device)
    after = None if options.after is None else open_segment(options.after)
    if options.overwrite:
        remove_unused(options.output)
        remove_unused(groups_path(options.output))
    chosen = TrackOptions(length, options.split_at_low_motion, after, TrackConfig(cameras=options.cameras))
    path, done, last, spent = options.output, 0, len(source) - 1, list[float]()
    with (
        interruption(
            lambda: f"Frame {done} of {last} was tracked; give the same command to go on from the last start."
        ),
        StopSignal() as ending,
        counting_bars("tracking", TimeElapsedColumn(), TimeRemainingColumn(), console=Console()) as bars,
        closing(track_capture(path, source, base, chosen, backend)) as frames,
    ):
        task = bars.add_task("tracking", total=last)
        for progress in frames:
            done = progress.frame
            spent.append(progress.cpu_seconds)
            bars.update(task, completed=done)
            ending.end(whole=done == last)
    groups, size = open_track(path).groups or [], human_bytes(path.stat().st_size)
    listed = " ".join(f"{first}:{end}" for first, end in groups[:8]) + (" ..." if len(groups) > 8 else "")
    took = f"; {sum(spent) / len(spent):.2f} core-seconds a frame" if spent else ""
    print_lines(
        Console(), f"Wrote {path}: {len(source)} frames, {size}; {len(groups)} groups in {path}.groups: {listed}{took}"
    )


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
    track: Annotated[Path | None, shown_as("TRACK")] = None
    """The track of the capture; may be left out for A = 0 only."""
    iterations: Number = None
    """Optimisation steps of the group's first frame. Default: eleven times those of an online frame."""
    rounds: int = 3
    """Rounds of scene flow, spawning and iterations of the group's first frame."""
    device: Device = "auto"
    """Compute back-end."""
    overwrite: Flag = False
    """Replace SEGMENT when it exists."""


def fit_group(arguments: list[str]) -> None:
    """Fits with a progress display."""
    options = parse_options(FitGroup, "fit-group", arguments=arguments)
    check_ending(options.output, ".sgs", command="fit-group")
    if re.fullmatch(r"\d+:\d+", options.frames) is None:
        raise UsageError(f"--frames {options.frames}: a group is A:B, such as --frames 60:120.")
    if (options.iterations is not None and options.iterations < 1) or options.rounds < 1:
        raise UsageError("--iterations and --rounds must be at least 1.")
    first, end = map(int, options.frames.split(":"))
    if first >= end:
        raise UsageError(f"--frames {options.frames} is empty; B is the frame after the last one.")
    from structgstream.groups.first_frame import GroupStartConfig
    from structgstream.groups.unit import SegmentTask, fit_segment
    from structgstream.kernels.backend import select_backend

    logging.basicConfig(format="structgstream: %(message)s")  # warnings between progress lines
    start = GroupStartConfig(iterations=options.iterations, rounds=options.rounds)
    task = SegmentTask(options.scene, options.init, options.track, first, end, start)
    run = fit_segment(
        options.output,
        task,
        select_backend(options.device),
        overwrite=options.overwrite,
        on_step=lambda step: progress.step(step),  # Created below, because it needs the number of existing frames.
    )
    if run is None:
        print_lines(Console(), f"{options.output} is finished.")
        return
    done = run.done
    with (
        interruption(lambda: f"{done - first} of {end - first} frames are safe; give the same command to go on."),
        StopSignal() as ending,
        display(end, done=done) as progress,
        closing(run.reports) as reports,
    ):
        for report in reports:
            progress.frame(report)
            done = report.index + 1
            ending.end(whole=done == end)
    print_lines(Console(), f"Wrote {options.output}")


@dataclass(frozen=True)
class Join:
    """Joins groups of frames that were fitted separately to one stream (docs/cluster.md).

    Verifies every checksum, and that all segments have the same header and contain every frame exactly once. Static
    content is blended at the border of two groups, so that it does not flicker there.

    Example: structgstream join groups/*.sgs -o ball.sgs
    """

    segments: Annotated[tyro.conf.Positional[tuple[Path, ...]], shown_as("SEGMENT [SEGMENT ...]")]
    """Segments that fit-group has written, in any order."""
    output: StreamOutput
    """The stream file to write."""
    check: Flag = False
    """Decode every frame of the result, too."""
    plain: Flag = False
    """Copy the packets of every group as they are, without blending."""
    device: Device = "auto"
    """Compute back-end of the blending."""
    workers: Number = None
    """Processes of one thread each that blend borders. Default: one a core; one on a GPU."""
    overwrite: Flag = False
    """Replace OUT.sgs when it exists."""


def join(arguments: list[str]) -> None:
    """Writes the file, and prints the blended seams and its size."""
    options = parse_options(Join, "join", arguments=arguments)
    output = options.output
    check_ending(output, ".sgs", command="join")
    if not options.segments:
        raise UsageError("join needs the segments of a stream.")
    check_new(output, overwrite=options.overwrite)
    from structgstream.evaluation.environment import usable_cores
    from structgstream.groups.join import join_segments
    from structgstream.kernels.backend import select_backend

    backend = None if options.plain or len(options.segments) < 2 else select_backend(options.device)
    usual = 1 if backend is None or backend.name == "cuda" else usable_cores()
    workers, console = usual if options.workers is None else options.workers, Console()

    def report(border: "Border") -> None:
        print_lines(
            console,
            f"Border at frame {border.frame}: {border.blended:,} anchors keep their values of the frame before; "
            f"{border.withdrawn:,} do not, because a mixture of the two fits would be visible there.",
        )

    frames = join_segments(
        options.segments, output, check=options.check, backend=backend, workers=workers, on_border=report
    )
    size = human_bytes(output.stat().st_size)
    print_lines(console, f"Wrote {output}: {frames_text(frames)} of {len(options.segments)} groups, {size}")
