# SPDX-License-Identifier: Apache-2.0
"""Commands between formats: ``export``, ``import``, ``archive`` and ``add-sound``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro
from rich.console import Console
from rich.table import Table

from structgstream.cli.app import UsageError, usage_errors
from structgstream.cli.options import (
    EXPORTS,
    Device,
    Flag,
    Folder,
    StreamFile,
    check_ending,
    check_new,
    parse_options,
)
from structgstream.cli.progress import frame_bar, frames_text, human_bytes, print_lines
from structgstream.exporters.formats import FORMATS, Format, FrameOptions, PageFormat, SpzVersion


@dataclass(frozen=True)
class Export:
    """Writes the stream as a page with a player, or frames as plain 3D Gaussians for other programs.

    OUT.html is one page with a player and the whole stream, which opens without a server. --format site gives a folder
    for any web server, from which a viewer fetches only the played packets.

    OUT.ply, .splat, .spz, .sog or .glb is one frame for other programs, OUT.usd or .4dgs has all frames, OUT.zip is a
    zip and any other name a folder of frame_000000.ply and so on. View-dependent opacity and shape are averaged over
    the training cameras; colours are spherical harmonics fitted to their views; what that loses is printed. Units are
    the capture's own, axes too (.spz, .glb, .usd, .4dgs: y up, z back). --list shows what each format is for.

    Example: structgstream export ball.sgs -o ball.html

    Example: structgstream export ball.sgs --frame 5 -o ball.ply

    Example: structgstream export ball.sgs --frames 0 19 --format spz -o ball-spz

    Example: structgstream export ball.sgs -o ball.usd
    """

    stream: tyro.conf.Positional[Annotated[Path | None, tyro.conf.arg(metavar="STREAM", help_behavior_hint="")]] = None
    """The stream file."""
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"], metavar="OUT", help_behavior_hint="")] = None
    """Output file or folder. Default: a file (with --frame) or a folder next to the stream."""
    format: Annotated[Format | PageFormat | None, tyro.conf.arg(help_behavior_hint="")] = None
    """Format of the files. Default: the suffix of OUT, else ply."""
    frame: Annotated[int | None, tyro.conf.arg(metavar="N", help_behavior_hint="")] = None
    """Export only this frame."""
    frames: Annotated[tuple[int, int] | None, tyro.conf.arg(metavar="FIRST LAST", help_behavior_hint="")] = None
    """First and last frame to export. Default: all."""
    sh_degree: Annotated[int | None, tyro.conf.arg(metavar="0..3", help_behavior_hint="")] = None
    """Degree of the spherical harmonics. Default: 1; .splat has none."""
    low_pass: Annotated[float, tyro.conf.arg(metavar="0..1", help_behavior_hint="")] = 0.0
    """Widen Gaussians by this variance, in squared training pixels, for viewers that show the scene larger than it was
    filmed (0.2) or have no low-pass of their own (0.3). Default: 0, best at the size of the training pictures."""
    crop: Annotated[
        tuple[float, float, float, float, float, float] | None,
        tyro.conf.arg(metavar="X0 Y0 Z0 X1 Y1 Z1", help_behavior_hint=""),
    ] = None
    """Leave out Gaussians outside this box: its lowest and its highest corner, in units of the capture."""
    min_opacity: Annotated[float, tyro.conf.arg(metavar="0..1", help_behavior_hint="")] = 0.0
    """Leave out Gaussians below this opacity."""
    max_splats: Annotated[int | None, tyro.conf.arg(metavar="N", help_behavior_hint="")] = None
    """Largest number of Gaussians of a frame; the smallest and most transparent are left out."""
    pad_sh: Flag = False
    """Write all 45 f_rest properties of a .ply, which some importers need."""
    spz_version: Annotated[SpzVersion, tyro.conf.arg(help_behavior_hint="")] = 2
    """Version of .spz: all readers know 2; 3 and 4 have finer rotations, 4 is compressed with zstd."""
    list: Flag = False
    """List the formats: what each is for, and what reads it."""
    device: Device = "auto"
    """Back-end that evaluates the MLPs."""


def export(arguments: list[str]) -> None:
    """Exports and prints the path of the result."""
    options = parse_options(Export, "export", arguments=arguments)
    if options.list:
        _list_formats(Console())
        return
    if options.stream is None:
        raise UsageError("export needs a stream file, or --list.")
    stream = options.stream
    check_ending(options.output, *EXPORTS, ".zip", ".html", command="export", folder=True)
    from structgstream.exporters.formats import check_page, choose_frames, destination

    frame, frames = options.frame, options.frames
    chosen = FrameOptions(
        degree=options.sh_degree,
        low_pass=options.low_pass,
        box=options.crop,
        min_opacity=options.min_opacity,
        max_splats=options.max_splats,
        pad_sh=options.pad_sh,
        spz_version=options.spz_version,
    )
    with usage_errors():
        output, format = destination(stream, options.output, format=options.format, frame=frame, frames=frames)
        if format == "html" or format == "site":
            check_page(frame=frame, frames=frames, options=chosen)
            _export_page(stream, output, format)
            return
        chosen.check(format)
    from structgstream.codec.reader import open_stream
    from structgstream.exporters.write import write_frames
    from structgstream.kernels.backend import select_backend

    reader = open_stream(stream, by_index=options.frame is not None)
    with usage_errors():
        numbers = choose_frames(reader.runs, output, frame=frame, frames=frames)
    backend = select_backend(options.device)
    gaussians, files, loss = 0, set[Path](), None
    with frame_bar("exporting", len(numbers)) as advance:
        for written in write_frames(reader, numbers, output, format=format, backend=backend, options=chosen):
            files.add(written.path)
            gaussians += written.gaussians
            loss = loss or written.loss
            advance()
    size_bytes = sum(path.stat().st_size for path in files)
    console = Console()
    print_lines(
        console, f"Wrote {output}: {frames_text(len(numbers))}, {gaussians:,} Gaussians, {human_bytes(size_bytes)}"
    )
    if loss is not None:
        held_out = "" if loss.held_out is None else f", {loss.held_out:.1f} dB at the held-out ones"
        print_lines(
            console,
            f"Plain Gaussians of frame {numbers[0]}, against the stream's own pictures: PSNR {loss.training:.1f} dB at "
            f"the training cameras{held_out}.",
        )
    others = sorted(set(output.glob(f"frame_*.{format}")) - files) if output.is_dir() else []
    if others:
        print_lines(
            console,
            f"{output} also has {frames_text(len(others))} of an earlier export, such as {others[-1].name}; viewers "
            "take all of them for one sequence.",
        )
    if reader.damage:
        print_lines(console, f"The stream is damaged: {reader.cut_reason}.")


def _list_formats(console: Console) -> None:
    table = Table(box=None, pad_edge=False)
    for title in ("format", "what for", "read by", "file", "SH degree"):
        table.add_column(title, overflow="fold")
    for name, info in FORMATS.items():
        file = "all frames" if info.all_frames else "one frame"
        table.add_row(name, info.purpose, info.readers, file, f"0 to {info.max_degree}" if info.max_degree else "0")
    table.add_row("html", "one page with a player and the whole stream", "browsers", "all frames", "")
    table.add_row("site", "the same as a folder for a web server", "browsers", "all frames", "")
    console.print(table)


def _export_page(path: Path, output: Path, format: PageFormat) -> None:
    from structgstream.serve.pages import StreamFile as ServedStream
    from structgstream.serve.pages import write_page, write_site

    stream = ServedStream(path)
    if format == "html":
        size_bytes = write_page(output, stream)
        then = f"open it in a browser: {output.resolve().as_uri()}"
    else:
        size_bytes = write_site(output, stream)
        then = "put the folder on any web server"
    print_lines(Console(), f"Wrote {output}, {human_bytes(size_bytes)}; {then}")


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


def import_files(arguments: list[str]) -> None:
    """Writes the file; prints its size and what is lost."""
    options = parse_options(Import, "import", arguments=arguments)
    output = options.output
    check_ending(output, ".sgs", command="import")
    check_new(output, overwrite=options.overwrite)
    if not 0.0 < options.fps <= 1000.0:
        raise UsageError(f"--fps {options.fps:g} is no number of frames per second.")
    from structgstream.codec.fields.packet_fields import MAX_FREE
    from structgstream.data.open import open_capture
    from structgstream.exporters.ply import find_sequence
    from structgstream.kernels.backend import select_backend
    from structgstream.sequence_import import import_sequence

    if options.max_splats is not None and not 0 < options.max_splats <= MAX_FREE:
        raise UsageError(f"--max-splats {options.max_splats} is not one of 1 to {MAX_FREE}.")
    files = find_sequence(options.sequence)
    sign = -1.0 if options.up.startswith("-") else 1.0
    x, y, z = UP[options.up[-1]]
    with frame_bar("importing", len(files)) as advance:
        found = import_sequence(
            files,
            output,
            fps=options.fps,
            backend=select_backend(options.device),
            rig=None if options.capture is None else open_capture(options.capture).rig,
            down=(sign * x, sign * y, sign * z),
            max_splats=options.max_splats,
            on_frame=advance,
        )
    console, size_bytes = Console(), output.stat().st_size
    low, high = found.counts
    count = f"{high:,}" if low == high else f"{low:,} to {high:,}"
    print_lines(
        console,
        f"Wrote {output}: {frames_text(found.frames)} of {count} Gaussians, {human_bytes(size_bytes)}, "
        f"{human_bytes(round(size_bytes / found.frames))} a frame",
    )
    if found.far:
        print_lines(
            console, f"Left out: up to {found.far:,} Gaussians of a frame that are too far away for the stream's steps."
        )
    if found.unread:
        print_lines(console, f"Not read, since a plain Gaussian has no such thing: {', '.join(found.unread)}.")
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


@dataclass(frozen=True)
class Archive:
    """Turns a folder of segments into one stream file: the very bytes that reconstruct would have written as a file.

    The SHA-256 of every file is verified. A stream of which frames have left the window (--window) is refused.

    Example: structgstream archive ball -o ball.sgs
    """

    segments: tyro.conf.Positional[Folder]
    """The folder that reconstruct --sink segments has written."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="OUT.sgs")]
    """The stream file to write."""
    overwrite: Flag = False
    """Replace OUT.sgs when it exists."""


def archive(arguments: list[str]) -> None:
    """Writes the file and prints its size."""
    options = parse_options(Archive, "archive", arguments=arguments)
    output = options.output
    check_ending(output, ".sgs", command="archive")
    check_new(output, overwrite=options.overwrite)
    from structgstream.codec.segments.store import FolderStore
    from structgstream.codec.segments.stored_bytes import write_archive

    frames = write_archive(FolderStore(options.segments), output)
    print_lines(Console(), f"Wrote {output}: {frames_text(frames)}, {human_bytes(output.stat().st_size)}")


@dataclass(frozen=True)
class AddSound:
    """Stores sound with a stream that was made without it, such as one of parallel or join; frames are copied.

    Example: structgstream add-sound ball.sgs basketball --sound cam03 -o heard.sgs
    """

    stream: tyro.conf.Positional[StreamFile]
    """The stream."""
    capture: tyro.conf.Positional[Folder]
    """The capture that it was made from."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="OUT.sgs")]
    """The stream file to write."""
    sound: Annotated[str, tyro.conf.arg(metavar="CAMERA|FILE|auto")] = "auto"
    """As of reconstruct: the sound of a camera, of a file, or of the best microphone."""
    sound_offset: Annotated[float | None, tyro.conf.arg(metavar="SECONDS", help_behavior_hint="")] = None
    """As of reconstruct: when the file begins, in seconds after the first frame of the capture."""
    overwrite: Flag = False
    """Replace OUT.sgs when it exists."""


def add_sound(arguments: list[str]) -> None:
    """Writes the file and prints where its sound is from."""
    options = parse_options(AddSound, "add-sound", arguments=arguments)
    output = options.output
    check_ending(output, ".sgs", command="add-sound")
    check_new(output, overwrite=options.overwrite)
    from structgstream.atomic_files import renamed_on_success
    from structgstream.codec.reader import open_stream
    from structgstream.codec.sinks import FileSink
    from structgstream.evaluation.recording import capture_of
    from structgstream.preparation.sound import chosen_sound
    from structgstream.recorder import copy_with_sound

    with open_stream(options.stream) as reader:
        if output.exists() and output.samefile(options.stream):
            raise UsageError("add-sound reads the stream while it writes another; give another name with -o.")
        source = capture_of(reader.header, options.capture, frames=len(reader))
        sound = chosen_sound(source, options.capture, options.sound, offset_seconds=options.sound_offset)
        if sound is None:
            raise UsageError("--sound none adds nothing; name a camera or a file.")
        with renamed_on_success(output) as part:  # half a stream would look like a shorter one
            copy_with_sound(reader, FileSink(part, overwrite=True), sound, name=str(options.stream))
    print_lines(Console(), f"Wrote {output}: {frames_text(len(reader))}, sound of {sound.name}")
