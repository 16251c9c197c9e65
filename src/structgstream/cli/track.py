# SPDX-License-Identifier: Apache-2.0
"""``structgstream track``."""

from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from structgstream.cli.app import Interrupted, UsageError
from structgstream.cli.options import Device, Flag, Folder, StreamFile, check_ending, parse_options
from structgstream.cli.progress import human_bytes, print_lines
from structgstream.cli.signals import Terminated, Termination

if TYPE_CHECKING:
    from structgstream.data.source import FrameSource
    from structgstream.groups.base import GroupBase
    from structgstream.groups.track_pass import TrackOptions
    from structgstream.kernels.backend import Backend


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
    """A stream whose header and frame 0 the groups share: reconstruct --frames 1, or any longer stream."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="TRACK")]
    """The track to write."""
    groups: Annotated[int | None, tyro.conf.arg(metavar="N", help_behavior_hint="")] = None
    """Frames of a group. Default: as many as from one key packet to the next."""
    split_at_low_motion: Flag = False
    """Begin groups where few pixels change, half of N to one and a half times N frames apart."""
    allow_unaligned: Flag = False
    """Allow an N that is no multiple of the interval of key packets; each group then costs one more key packet."""
    frames: Annotated[int | None, tyro.conf.arg(metavar="M", help_behavior_hint="")] = None
    """Number of frames. Default: all."""
    after: Annotated[Path | None, tyro.conf.arg(metavar="SEGMENT", help_behavior_hint="")] = None
    """Begin at the end of this finished segment, with its fitted positions, which are more exact than tracked ones: for
    the groups after it."""
    cameras: Annotated[int | None, tyro.conf.arg(metavar="N", help_behavior_hint="")] = None
    """Largest number of cameras for a frame; of more, every second or third is used, in turn. Default: half of the
    rig, from 6 to 14."""
    device: Device = "auto"
    """Compute back-end."""
    overwrite: Flag = False
    """Replace TRACK when it exists."""


def main(arguments: list[str]) -> None:
    """Tracks with a progress bar, and lists the groups."""
    options = parse_options(Track, "track", arguments=arguments)
    check_ending(options.output, command="track")
    from structgstream.atomic_files import partial_path
    from structgstream.cli.app import usage_errors
    from structgstream.groups.base import GroupBase
    from structgstream.groups.boundaries import check_length, groups_path
    from structgstream.groups.pictures import open_for
    from structgstream.groups.segment_file import open_segment
    from structgstream.groups.track_pass import TrackOptions
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
    if options.overwrite:
        for path in (options.output, partial_path(options.output), groups_path(options.output)):
            path.unlink(missing_ok=True)
    options.output.parent.mkdir(parents=True, exist_ok=True)
    after = None if options.after is None else open_segment(options.after)
    chosen = TrackOptions(length, options.split_at_low_motion, after, TrackConfig(cameras=options.cameras))
    spent = _track(options.output, source, base, chosen, backend)
    _say(options.output, len(source), spent)


def _track(
    path: Path, source: "FrameSource", base: "GroupBase", options: "TrackOptions", backend: "Backend"
) -> float | None:
    """Tracks what is missing; mean processor time of a frame in seconds, None if nothing was."""
    from structgstream.groups.track_pass import track_capture

    columns = [TextColumn("{task.description}"), BarColumn(bar_width=32), MofNCompleteColumn(), TimeElapsedColumn()]
    done, spent = 0, list[float]()
    try:
        with (
            Termination() as ending,
            Progress(*columns, TimeRemainingColumn(), console=Console()) as bars,
            closing(track_capture(path, source, base, options, backend)) as frames,
        ):
            task = bars.add_task("tracking", total=len(source) - 1)
            for progress in frames:
                done = progress.frame
                spent.append(progress.cpu_seconds)
                bars.update(task, completed=done)
                if ending.asked and done + 1 < len(source):
                    raise Terminated
    except KeyboardInterrupt as error:
        ended = Terminated if isinstance(error, Terminated) else Interrupted
        raise ended(
            f"Frame {done} of {len(source) - 1} was tracked; give the same command to go on from the last start."
        ) from None
    return sum(spent) / len(spent) if spent else None


def _say(path: Path, frames: int, spent: float | None) -> None:
    from structgstream.groups.track_file import open_track

    groups = open_track(path).groups or []
    size = human_bytes(path.stat().st_size)
    print_lines(
        Console(),
        f"Wrote {path}: {frames} frames, {size}; {len(groups)} groups in {path}.groups: "
        + " ".join(f"{first}:{end}" for first, end in groups[:8])
        + (" ..." if len(groups) > 8 else "")
        + ("" if spent is None else f"; {spent:.2f} core-seconds a frame"),
    )
