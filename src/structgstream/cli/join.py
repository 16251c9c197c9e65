# SPDX-License-Identifier: Apache-2.0
"""``structgstream join``."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro
from rich.console import Console

from structgstream.cli.app import UsageError
from structgstream.cli.options import Device, Flag, check_ending, parse_options
from structgstream.cli.progress import human_bytes, print_lines

if TYPE_CHECKING:
    from structgstream.groups.blending import Border
    from structgstream.kernels.backend import Backend


@dataclass(frozen=True)
class Join:
    """Joins groups of frames that were fitted separately to one stream (docs/cluster.md).

    Every checksum is verified, and that the segments have one header and every frame once. Static content is blended
    at the border of two groups, so that it does not flicker there.

    Example: structgstream join groups/*.sgs -o ball.sgs
    """

    segments: Annotated[
        tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="SEGMENT [SEGMENT ...]", help_behavior_hint="")
    ]
    """Segments that fit-group has written, in any order."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="OUT.sgs")]
    """The stream file to write."""
    check: Flag = False
    """Decode every frame of the result, too."""
    plain: Flag = False
    """Copy the packets of every group as they are, without blending."""
    device: Device = "auto"
    """Compute back-end of the blending."""
    workers: Annotated[int | None, tyro.conf.arg(metavar="N", help_behavior_hint="")] = None
    """Processes of one thread each that blend borders. Default: one a core; one on a GPU."""
    overwrite: Flag = False
    """Replace OUT.sgs when it exists."""


def main(arguments: list[str]) -> None:
    """Writes the file, and prints the blended seams and its size."""
    options = parse_options(Join, "join", arguments=arguments)
    output = options.output
    check_ending(output, ".sgs", command="join")
    if not options.segments:
        raise UsageError("join needs the segments of a stream.")
    if output.exists() and not options.overwrite:
        raise UsageError(f"{output} exists; replace it with --overwrite, or choose another name.")
    from structgstream.groups.join import join_segments
    from structgstream.kernels.backend import select_backend

    backend = None if options.plain or len(options.segments) < 2 else select_backend(options.device)
    console = Console()
    frames = join_segments(
        options.segments,
        output,
        check=options.check,
        backend=backend,
        workers=_workers(options.workers, backend),
        on_border=lambda border: _tell(border, console),
    )
    what = "1 frame" if frames == 1 else f"{frames} frames"
    print_lines(
        console, f"Wrote {output}: {what} of {len(options.segments)} groups, {human_bytes(output.stat().st_size)}"
    )


def _workers(asked: int | None, backend: "Backend | None") -> int:
    from structgstream.evaluation.environment import usable_cores

    if asked is not None or backend is None:
        return 1 if asked is None else asked
    return 1 if backend.name == "cuda" else usable_cores()


def _tell(border: "Border", console: Console) -> None:
    print_lines(
        console,
        f"Border at frame {border.frame}: {border.blended:,} anchors keep their values of the frame before; "
        f"{border.withdrawn:,} do not, as two fits side by side would show there.",
    )
