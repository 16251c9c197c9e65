# SPDX-License-Identifier: Apache-2.0
"""Commands between formats: ``export``, ``import``, ``archive`` and ``add-sound``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro
from rich.console import Console

from structgstream.cli.app import UsageError, usage_errors
from structgstream.cli.options import (
    EXPORTS,
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
from structgstream.cli.progress import frame_bar, frames_text, human_bytes, plain_table, print_lines
from structgstream.exporters.formats import (
    FORMATS,
    Format,
    FrameOptions,
    PageFormat,
    SpzVersion,
    check_page,
    choose_frames,
    destination,
)


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

    stream: tyro.conf.Positional[Annotated[Path | None, shown_as("STREAM")]] = None
    """The stream file."""
    output: Annotated[Path | None, shown_as("OUT", "-o")] = None
    """Output file or folder. Default: a file (with --frame) or a folder next to the stream."""
    format: Annotated[Format | PageFormat | None, shown_as()] = None
    """Format of the files. Default: the suffix of OUT, else ply."""
    frame: Number = None
    """Export only this frame."""
    frames: Annotated[tuple[int, int] | None, shown_as("FIRST LAST")] = None
    """First and last frame to export. Default: all."""
    sh_degree: Annotated[int | None, shown_as("0..3")] = None
    """Degree of the spherical harmonics. Default: 1; .splat has none."""
    low_pass: Annotated[float, shown_as("0..1")] = 0.0
    """Widen Gaussians by this variance, in squared training pixels, for viewers that show the scene larger than it was
    filmed (0.2) or have no low-pass of their own (0.3). Default: 0, best at the size of the training pictures."""
    crop: Annotated[tuple[float, float, float, float, float, float] | None, shown_as("X0 Y0 Z0 X1 Y1 Z1")] = None
    """Leave out Gaussians outside this box: its lowest and its highest corner, in units of the capture."""
    min_opacity: Annotated[float, shown_as("0..1")] = 0.0
    """Leave out Gaussians below this opacity."""
    max_splats: Number = None
    """Largest number of Gaussians of a frame; the smallest and most transparent are left out."""
    pad_sh: Flag = False
    """Write all 45 f_rest properties of a .ply, which some importers need."""
    spz_version: Annotated[SpzVersion, shown_as()] = 2
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
    size = human_bytes(sum(path.stat().st_size for path in files))
    said = [f"Wrote {output}: {frames_text(len(numbers))}, {gaussians:,} Gaussians, {size}"]
    if loss is not None:
        held_out = "" if loss.held_out is None else f", {loss.held_out:.1f} dB at the held-out ones"
        said.append(
            f"Plain Gaussians of frame {numbers[0]}, against the stream's own pictures: PSNR {loss.training:.1f} dB at "
            f"the training cameras{held_out}."
        )
    if output.is_dir() and (others := sorted(set(output.glob(f"frame_*.{format}")) - files)):
        said.append(
            f"{output} also has {frames_text(len(others))} of an earlier export, such as {others[-1].name}; viewers "
            "take all of them for one sequence."
        )
    if reader.damage:
        said.append(f"The stream is damaged: {reader.cut_reason}.")
    print_lines(Console(), *said)


def _list_formats(console: Console) -> None:
    table = plain_table("format", "what for", "read by", "file", "SH degree", overflow="fold")
    for name, info in FORMATS.items():
        file = "all frames" if info.all_frames else "one frame"
        table.add_row(name, info.purpose, info.readers, file, f"0 to {info.max_degree}" if info.max_degree else "0")
    table.add_row("html", "one page with a player and the whole stream", "browsers", "all frames", "")
    table.add_row("site", "the same as a folder for a web server", "browsers", "all frames", "")
    console.print(table)


def _export_page(path: Path, output: Path, format: PageFormat) -> None:
    from structgstream.serve.pages import StreamFile as ServedStream
    from structgstream.serve.pages import write_page, write_site

    if format == "html":
        write, then = write_page, f"open it in a browser: {output.resolve().as_uri()}"
    else:
        write, then = write_site, "put the folder on any web server"
    print_lines(Console(), f"Wrote {output}, {human_bytes(write(output, ServedStream(path)))}; {then}")


@dataclass(frozen=True)
class Import:
    """Makes a stream of a numbered .ply sequence of another trainer, which the player plays (docs/export.md).

    Gaussians keep their shapes; each gets one colour, the mean of its spherical harmonics over the cameras. If all
    files have the same Gaussians in the same order, the stream contains their changes; otherwise every frame whole.

    Example: structgstream import plys -o ball.sgs --fps 25
    """

    sequence: tyro.conf.Positional[Folder]
    """Folder of the files: frame_0000.ply and so on."""
    output: StreamOutput
    """The stream file to write."""
    fps: Annotated[float, tyro.conf.arg(metavar="N")] = 30.0
    """Frames per second."""
    capture: Annotated[Path | None, shown_as("FOLDER")] = None
    """Capture in the units of the files, for its cameras. Default: a ring of cameras around the Gaussians."""
    up: Literal["x", "y", "z", "-x", "-y", "-z"] = "-y"
    """Axis that points up, for the ring."""
    max_splats: Number = None
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
    x, y, z = (sign * (-1.0 if axis == options.up[-1] else 0.0) for axis in "xyz")
    with frame_bar("importing", len(files)) as advance:
        found = import_sequence(
            files,
            output,
            fps=options.fps,
            backend=select_backend(options.device),
            rig=None if options.capture is None else open_capture(options.capture).rig,
            down=(x, y, z),
            max_splats=options.max_splats,
            on_frame=advance,
        )
    size_bytes, (low, high) = output.stat().st_size, found.counts
    count = f"{high:,}" if low == high else f"{low:,} to {high:,}"
    said = [
        f"Wrote {output}: {frames_text(found.frames)} of {count} Gaussians, {human_bytes(size_bytes)}, "
        f"{human_bytes(round(size_bytes / found.frames))} a frame"
    ]
    if found.far:
        said.append(f"Left out: up to {found.far:,} Gaussians of a frame that are too far away for the stream's steps.")
    if found.unread:
        said.append(f"Not read, since a plain Gaussian has no such thing: {', '.join(found.unread)}.")
    if found.linked:
        said.append("All files have the same Gaussians; the stream contains their changes.")
    else:
        said.append("The files have different Gaussians, so every frame is stored by itself.")
    pictures = f"Pictures of frame 0 against those of the file: PSNR {found.psnr:.1f} dB"
    if found.degree:
        pictures += f"; one colour a Gaussian in place of spherical harmonics of degree {found.degree} alone gives "
        pictures += f"{found.color_psnr:.1f} dB"
    print_lines(Console(), *said, f"{pictures}.")


@dataclass(frozen=True)
class Archive:
    """Turns a folder of segments into one stream file: the very bytes that reconstruct would have written as a file.

    The SHA-256 of every file is verified. A stream of which frames have left the window (--window) is refused.

    Example: structgstream archive ball -o ball.sgs
    """

    segments: tyro.conf.Positional[Folder]
    """The folder that reconstruct --sink segments has written."""
    output: StreamOutput
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
    output: StreamOutput
    """The stream file to write."""
    sound: Annotated[str, tyro.conf.arg(metavar="CAMERA|FILE|auto")] = "auto"
    """As in reconstruct: the sound of a camera, of a file, or of the best microphone."""
    sound_offset: Annotated[float | None, shown_as("SECONDS")] = None
    """As in reconstruct: when the file begins, in seconds after the first frame of the capture."""
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
