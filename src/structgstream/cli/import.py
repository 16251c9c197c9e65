# SPDX-License-Identifier: Apache-2.0
"""``structgstream import``; loaded by its name, because ``import`` is a keyword."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from structgstream.cli.app import UsageError
from structgstream.cli.options import Device, Flag, Folder, check_ending, parse_options
from structgstream.cli.progress import human_bytes, print_lines

UP = {"x": (-1.0, 0.0, 0.0), "y": (0.0, -1.0, 0.0), "z": (0.0, 0.0, -1.0)}


@dataclass(frozen=True)
class Import:
    """Makes a stream of a numbered .ply sequence of another trainer, which the player plays (docs/export.md).

    Gaussians keep their shapes; each gets one colour, the mean of its spherical harmonics over the cameras. If all
    files have the same Gaussians in the same order, the stream contains their changes; otherwise every frame whole.

    Example: structgstream import plys -o ball.sgs --fps 25
    """

    sequence: tyro.conf.Positional[Folder]
    """Folder of the files: frame_0000.ply and so on."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="OUT.sgs")]
    """The stream file to write."""
    fps: Annotated[float, tyro.conf.arg(metavar="N")] = 30.0
    """Frames per second."""
    capture: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER", help_behavior_hint="")] = None
    """Capture in the units of the files, for its cameras. Default: a ring of cameras around the Gaussians."""
    up: Literal["x", "y", "z", "-x", "-y", "-z"] = "-y"
    """Axis that points up, for the ring."""
    max_splats: Annotated[int | None, tyro.conf.arg(metavar="N", help_behavior_hint="")] = None
    """Largest number of Gaussians of a frame; the smallest and most transparent are left out."""
    overwrite: Flag = False
    """Replace OUT.sgs when it exists."""
    device: Device = "auto"
    """Back-end that draws the pictures for the PSNR."""


def main(arguments: list[str]) -> None:
    """Writes the file; prints its size and what is lost."""
    options = parse_options(Import, "import", arguments=arguments)
    output = options.output
    check_ending(output, ".sgs", command="import")
    if output.exists() and not options.overwrite:
        raise UsageError(f"{output} exists; replace it with --overwrite, or choose another name.")
    if not 0.0 < options.fps <= 1000.0:
        raise UsageError(f"--fps {options.fps:g} is no number of frames per second.")
    from structgstream.codec.fields.free_rows import MAX_FREE
    from structgstream.data.open import open_capture
    from structgstream.exporters.ply_reader import find_sequence
    from structgstream.kernels.backend import select_backend
    from structgstream.sequence_import import import_sequence

    if options.max_splats is not None and not 0 < options.max_splats <= MAX_FREE:
        raise UsageError(f"--max-splats {options.max_splats} is not one of 1 to {MAX_FREE}.")
    files = find_sequence(options.sequence)
    sign = -1.0 if options.up.startswith("-") else 1.0
    x, y, z = UP[options.up[-1]]
    bar = Progress(
        TextColumn("importing"),
        BarColumn(bar_width=32),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        console=Console(stderr=True),
        transient=True,
    )
    with bar:
        task = bar.add_task("frames", total=len(files))
        found = import_sequence(
            files,
            output,
            fps=options.fps,
            backend=select_backend(options.device),
            rig=None if options.capture is None else open_capture(options.capture).rig,
            down=(sign * x, sign * y, sign * z),
            max_splats=options.max_splats or MAX_FREE,
            on_frame=lambda: bar.advance(task),
        )
    console, size_bytes = Console(), output.stat().st_size
    what = "1 frame" if found.frames == 1 else f"{found.frames} frames"
    low, high = found.counts
    count = f"{high:,}" if low == high else f"{low:,} to {high:,}"
    print_lines(
        console,
        f"Wrote {output}: {what} of {count} Gaussians, {human_bytes(size_bytes)}, "
        f"{human_bytes(round(size_bytes / found.frames))} a frame",
    )
    print_lines(
        console,
        "All files have the same Gaussians; the stream contains their changes."
        if found.linked
        else "The files have different Gaussians, so every frame is stored by itself.",
    )
    colors = (
        ""
        if not found.degree
        else (
            f"; one colour a Gaussian in place of spherical harmonics of degree {found.degree} alone gives "
            f"{found.color_psnr:.1f} dB"
        )
    )
    print_lines(console, f"Pictures of frame 0 against those of the file: PSNR {found.psnr:.1f} dB{colors}.")
