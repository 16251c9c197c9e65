# SPDX-License-Identifier: Apache-2.0
"""``structgstream export``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from structgstream.cli.app import usage_errors
from structgstream.cli.options import Device, StreamFile, check_ending, parse_options
from structgstream.cli.plain_text import say
from structgstream.cli.progress import human_bytes
from structgstream.exporters.formats import FORMATS, Format, PageFormat


@dataclass(frozen=True)
class Export:
    """Writes the stream as a page with a player, or frames as plain 3D Gaussians for other programs.

    OUT.html is one page with a player and the whole stream, which opens without a server. --format site gives a folder
    for any web server, from which a viewer fetches only the played packets.

    OUT.ply, OUT.splat or OUT.spz is one frame for other programs, any other name a folder of frame_000000.ply and so
    on. View-dependent opacity and shape are averaged over the training cameras; colours are spherical harmonics fitted
    to their views. Units and axes are the capture's own (.spz: y up, z back). Losses: docs/export.md.

    Example: structgstream export ball.sgs -o ball.html

    Example: structgstream export ball.sgs --frame 5 -o ball.ply

    Example: structgstream export ball.sgs --frames 0 19 --format spz -o ball-spz
    """

    stream: tyro.conf.Positional[StreamFile]
    """The stream file."""
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"], metavar="OUT", help_behavior_hint="")] = None
    """Output file or folder. Default: a file (with --frame) or a folder next to the stream."""
    format: Annotated[Format | PageFormat | None, tyro.conf.arg(help_behavior_hint="")] = None
    """Format of the files. Default: the suffix of OUT, else ply."""
    frame: Annotated[int | None, tyro.conf.arg(metavar="N", help_behavior_hint="")] = None
    """Export only this frame."""
    frames: Annotated[tuple[int, int] | None, tyro.conf.arg(metavar="FIRST LAST", help_behavior_hint="")] = None
    """First and last frame to export. Default: all."""
    sh_degree: Annotated[int | None, tyro.conf.arg(metavar="0..2", help_behavior_hint="")] = None
    """Degree of the spherical harmonics. Default: 1; .splat has none."""
    low_pass: Annotated[float, tyro.conf.arg(metavar="0..1", help_behavior_hint="")] = 0.0
    """Widen Gaussians by this variance, in squared training pixels, for viewers that show the scene larger than it was
    filmed (0.2) or have no low-pass of their own (0.3). Default: 0, best at the size of the training pictures."""
    device: Device = "auto"
    """Back-end that evaluates the MLPs."""


def main(arguments: list[str]) -> None:
    """Exports and prints the path of the result."""
    options = parse_options(Export, "export", arguments=arguments)
    check_ending(options.output, *(f".{name}" for name in (*FORMATS, "html")), command="export", folder=True)
    from structgstream.exporters.request import check_degree, check_low_pass, check_page, choose_frames, destination

    frame, frames = options.frame, options.frames
    with usage_errors():
        output, format = destination(options.stream, options.output, format=options.format, frame=frame, frames=frames)
        if format == "html" or format == "site":
            check_page(frame=frame, frames=frames, sh_degree=options.sh_degree, low_pass=options.low_pass)
            _export_page(options.stream, output, format)
            return
        degree = check_degree(options.sh_degree, format)
        low_pass = check_low_pass(options.low_pass)
    from structgstream.codec.reader import open_stream
    from structgstream.exporters.frames import write_frames
    from structgstream.kernels.backend import select_backend

    reader = open_stream(options.stream, by_index=options.frame is not None)
    with usage_errors():
        numbers = choose_frames(reader.runs, output, frame=frame, frames=frames)
    backend = select_backend(options.device)
    written = gaussians = 0
    bar = Progress(
        TextColumn("exporting"),
        BarColumn(bar_width=32),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        console=Console(stderr=True),
        transient=True,
    )
    with bar:
        task = bar.add_task("frames", total=len(numbers))
        files = write_frames(reader, numbers, output, format=format, backend=backend, degree=degree, low_pass=low_pass)
        for file in files:
            written += file.bytes
            gaussians += file.gaussians
            bar.advance(task)
    what = "1 frame" if len(numbers) == 1 else f"{len(numbers)} frames"
    text = f"Wrote {output}: {what}, {gaussians:,} Gaussians, {human_bytes(written)}"
    console = Console()
    say(console, text)
    if reader.damage:
        say(console, f"The stream is damaged: {reader.cut_reason}.")


def _export_page(path: Path, output: Path, format: PageFormat) -> None:
    from structgstream.serve.stream_file import StreamFile, write_page, write_site

    stream = StreamFile(path)
    if format == "html":
        size_bytes = write_page(output, stream)
        then = f"open it in a browser: {output.resolve().as_uri()}"
    else:
        size_bytes = write_site(output, stream)
        then = "put the folder on any web server"
    text = f"Wrote {output}, {human_bytes(size_bytes)}; {then}"
    say(Console(), text)
