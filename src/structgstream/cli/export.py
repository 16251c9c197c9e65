# SPDX-License-Identifier: Apache-2.0
"""``structgstream export``."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from structgstream.cli.app import UsageError
from structgstream.cli.options import Device, StreamFile, parsed
from structgstream.cli.progress import human_bytes
from structgstream.exporters.formats import FORMATS, PAGES, Format, PageFormat

if TYPE_CHECKING:
    from structgstream.codec.reader import StreamReader


@dataclass(frozen=True)
class Export:
    """Writes the stream as a page with a player, or frames as plain 3D Gaussians for other programs.

    OUT.html is one page that opens from a disk and plays the whole stream from any angle. --format site gives a folder
    for any web server, from which a viewer fetches only what is played.

    OUT.ply, OUT.splat or OUT.spz is one frame for other programs, any other name a folder of frame_000000.ply and so
    on. What depends on the camera is averaged over the training cameras; colours are spherical harmonics fitted to what
    they see. Units and axes are the capture's own (.spz: y up, z back). What is lost: docs/export.md.

    Example: structgstream export ball.sgs -o ball.html

    Example: structgstream export ball.sgs --frame 5 -o ball.ply

    Example: structgstream export ball.sgs --frames 0 19 --format spz -o ball-spz
    """

    stream: tyro.conf.Positional[StreamFile]
    """The stream file."""
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"], metavar="OUT", help_behavior_hint="")] = None
    """Where to write. Default: a file (with --frame) or a folder beside the stream."""
    format: Annotated[Format | PageFormat | None, tyro.conf.arg(help_behavior_hint="")] = None
    """Format of the files. Default: what the name of OUT says, else ply."""
    frame: Annotated[int | None, tyro.conf.arg(metavar="N", help_behavior_hint="")] = None
    """This frame only."""
    frames: Annotated[tuple[int, int] | None, tyro.conf.arg(metavar="FIRST LAST", help_behavior_hint="")] = None
    """From this frame to that, both included. Default: all."""
    sh_degree: Annotated[int | None, tyro.conf.arg(metavar="0..2", help_behavior_hint="")] = None
    """Degree of the spherical harmonics. Default: 1; .splat has none."""
    device: Device = "auto"
    """What evaluates the MLPs."""


def main(arguments: list[str]) -> None:
    """Exports and says where the result is."""
    options = parsed(Export, "export", arguments=arguments)
    if options.frame is not None and options.frames is not None:
        raise UsageError("--frame names one frame, --frames the first and the last; give one of them.")
    output, format = destination(options)
    if format == "html" or format == "site":
        _export_page(options, output, format)
        return
    degree = checked_degree(options.sh_degree, format)
    from structgstream.codec.reader import open_stream
    from structgstream.exporters.bake import Baking, baked
    from structgstream.exporters.write import write_gaussians
    from structgstream.kernels.backend import select_backend
    from structgstream.scene.state import on_device

    reader = open_stream(options.stream, by_index=options.frame is not None)
    numbers = chosen_frames(reader, options)
    single = output.suffix.lower().lstrip(".") in FORMATS and not output.is_dir()
    if single and len(numbers) > 1:
        raise UsageError(f"{output.name} holds one frame: choose it with --frame, or name a folder and --format.")
    backend = select_backend(options.device)
    baking = Baking() if degree is None else replace(Baking(), degree=degree)
    rig = reader.header.similarity.rig(reader.header.rig)
    cameras = [rig[name] for name in rig.training]
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
        for number in numbers:
            plain = baked(on_device(reader.scene(number), backend.device), cameras, backend, baking=baking)
            path = output if single else output / f"frame_{number:06d}.{format}"
            plain = plain.in_capture_units(reader.header.similarity)
            written += write_gaussians(path, plain, format=format)
            gaussians += len(plain)
            bar.advance(task)
    what = "1 frame" if len(numbers) == 1 else f"{len(numbers)} frames"
    text = f"Wrote {output}: {what}, {gaussians:,} Gaussians, {human_bytes(written)}"
    console = Console()
    console.print(text, highlight=False, markup=False, soft_wrap=True)
    if reader.damage:
        console.print(f"The stream is damaged: {reader.cut_reason}.", highlight=False, markup=False, soft_wrap=True)


def _export_page(options: Export, output: Path, format: PageFormat) -> None:
    if options.frame is not None or options.frames is not None or options.sh_degree is not None:
        raise UsageError("a page holds the whole stream; --frame, --frames and --sh-degree are for other formats.")
    from structgstream.player.stream_file import StreamFile
    from structgstream.player.write import write_page, write_site

    stream = StreamFile(options.stream)
    if format == "html":
        size_bytes = write_page(output, stream)
        then = f"open it in a browser: {output.resolve().as_uri()}"
    else:
        size_bytes = write_site(output, stream)
        then = "put the folder on any web server"
    text = f"Wrote {output}, {human_bytes(size_bytes)}; {then}"
    Console().print(text, highlight=False, markup=False, soft_wrap=True)


def destination(options: Export) -> tuple[Path, Format | PageFormat]:
    """Where to write and in which format.

    Raises:
        UsageError: the name asks for a format that there is not, or for another than --format.
    """
    format = options.format
    if options.output is None:
        format = format or "ply"
        stem = options.stream.stem
        if format == "html":
            return options.stream.with_suffix(".html"), format
        name = f"{stem}-{format}" if options.frame is None else f"{stem}-{options.frame}.{format}"
        return options.stream.with_name(name), format
    ending = options.output.suffix.lower().lstrip(".")
    if format == "html" and (options.output.is_dir() or ending != "html"):
        raise UsageError(f"a page is a file whose name ends in .html, unlike {options.output.name}.")
    if format == "site" or options.output.is_dir() or not ending:
        return options.output, format or "ply"
    for known in (*FORMATS, "html"):
        if ending == known:
            if format not in (None, known):
                raise UsageError(f"the name {options.output.name} asks for .{ending}, and --format for {format}.")
            return options.output, known
    if format is None:
        known = ", ".join((*FORMATS, *PAGES))
        raise UsageError(f"there is no format .{ending}; there are {known}. For a folder of this name add --format.")
    return options.output, format


def checked_degree(degree: int | None, format: Format) -> int | None:
    """The degree that is baked, or None for the measured choice.

    Raises:
        UsageError: there is no such degree, or the format cannot hold it.
    """
    from structgstream.scene.harmonics import MAX_DEGREE

    if degree is not None and not 0 <= degree <= MAX_DEGREE:
        raise UsageError(f"--sh-degree {degree} is not one of 0 to {MAX_DEGREE}.")
    if format == "splat":
        if degree:
            raise UsageError(f"a .splat file holds one colour a Gaussian; --sh-degree {degree} needs ply or spz.")
        return 0
    return degree


def chosen_frames(reader: "StreamReader", options: Export) -> list[int]:
    """Numbers of the frames to write.

    Raises:
        UsageError: there is no such frame, or it is lost.
    """
    if not reader.runs:
        raise UsageError("the stream has no whole frame.")
    if options.frame is None and options.frames is None:
        return [index for run in reader.runs for index in run]
    first, last = options.frames or (options.frame or 0, options.frame or 0)
    if first > last:
        raise UsageError(f"--frames names the first frame, then the last; {first} comes after {last}.")
    if not any(first in run and last in run for run in reader.runs):
        asked = f"frame {first}" if first == last else f"range from {first} to {last}"
        have = " and ".join(f"{run.start} to {run.stop - 1}" for run in reader.runs)
        raise UsageError(f"the stream has frames {have}; there is no {asked}.")
    return list(range(first, last + 1))
