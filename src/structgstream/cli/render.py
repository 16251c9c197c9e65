# SPDX-License-Identifier: Apache-2.0
"""``structgstream render``."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import count, islice, repeat, starmap
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro
from rich.console import Console

from structgstream.atomic_files import side_path
from structgstream.cli.app import UsageError, usage_errors
from structgstream.cli.options import Device, Flag, Number, StreamFile, check_ending, parse_options, shown_as
from structgstream.cli.progress import print_lines

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from structgstream.cameras import Camera
    from structgstream.codec.reader import StreamReader
    from structgstream.kernels.backend import Backend
    from structgstream.scene.scene import Scene

MIN_PATH_SECONDS = 4.0  # a shorter stream is played slowed, forward and backward, while the camera moves
MAX_PATH_SECONDS = 3600.0


@dataclass(frozen=True)
class Render:
    """Renders a camera of the rig, or a camera path, to a video or to pictures.

    OUT.mp4 gives a video, OUT.png one picture (with --frame), any other name a folder of PNGs. With --compare, which
    needs the capture, each picture shows truth, rendering, and their difference times four.

    Example: structgstream render ball.sgs --path orbit -o ball.mp4

    Example: structgstream render ball.sgs basketball --camera 10 --compare --frame 5 -o ball-10.png
    """

    stream: tyro.conf.Positional[StreamFile]
    """The stream file."""
    scene: Annotated[tyro.conf.Positional[Path | None], shown_as("[FOLDER]")] = None
    """The capture, for --compare."""
    output: Annotated[Path | None, shown_as("OUT", "-o")] = None
    """Output file or folder. Default: next to the stream, named after the camera or the path: a video, or a PNG with
    --frame and no --path."""
    camera: Annotated[str | None, shown_as("CAMERA")] = None
    """A camera of the rig; with --path orbit, the one to circle. Default: the first held-out one; for an orbit, and
    without a held-out one, the one nearest to the middle of the rig."""
    path: Annotated[Literal["orbit", "arc"] | None, shown_as()] = None
    """Camera path: an orbit around one camera, or an arc from one camera to another."""
    between: Annotated[tuple[str, str] | None, shown_as("CAMERA CAMERA")] = None
    """Ends of the arc. Default: two cameras well apart on the same side."""
    seconds: Annotated[float | None, shown_as()] = None
    """Duration of the path. Default: the stream's, at least 4 s; a shorter stream is played slowed, back and forth."""
    frame: Number = None
    """Render only this frame; a path then shows a fixed time. Default: all frames."""
    compare: Flag = False
    """Truth, rendering and difference side by side."""
    device: Device = "auto"
    """Back-end that renders."""


def main(arguments: list[str]) -> None:
    """Renders and prints the path of the result."""
    options = parse_options(Render, "render", arguments=arguments)
    check_ending(options.output, ".mp4", ".png", command="render", folder=True)
    if options.compare and (options.scene is None or options.path is not None):
        raise UsageError("--compare needs the capture's folder after the stream, and a camera, not a --path.")
    if options.scene is not None and not options.compare:
        raise UsageError("the capture's folder is only used with --compare.")
    if options.seconds is not None and not (options.path and 0.0 < options.seconds <= MAX_PATH_SECONDS):
        raise UsageError(f"--seconds is the duration of a --path, above 0 and at most {MAX_PATH_SECONDS:g}.")
    if options.between is not None and options.path != "arc":
        raise UsageError("--between gives the ends of --path arc.")
    from structgstream.codec.reader import open_stream
    from structgstream.exporters.formats import choose_frames
    from structgstream.kernels.backend import select_backend

    reader = open_stream(options.stream, by_index=options.frame is not None)
    output = options.output or default_output(options, reader)
    with usage_errors():
        choose_frames(reader.runs, output, frame=options.frame, frames=None)
    ending = output.suffix.lower()
    if ending == ".png" and options.frame is None:
        raise UsageError("a PNG holds one picture: choose it with --frame, or write an .mp4 or a folder.")
    backend = select_backend(options.device)
    if options.path is not None:
        pictures = path_pictures(
            reader,
            backend,
            path=options.path,
            camera=options.camera,
            between=options.between,
            seconds=options.seconds,
            frame=options.frame,
        )
    elif options.scene is not None:
        pictures = compared_pictures(reader, options.scene, backend=backend, options=options)
    else:
        pictures = camera_pictures(reader, backend, camera=choose_camera(reader, options.camera), frame=options.frame)
    if ending == ".png":
        pictures = islice(pictures, 1)
    is_whole_path = options.path is None or is_in_step(reader, path_length(reader, options.seconds))
    in_step = options.frame is None and is_whole_path
    if ending == ".mp4" and reader.header.sound is not None and not in_step:
        print_lines(Console(stderr=True), "The video has no sound, because it does not show the stream as it is.")
    if options.frame is None and not options.compare and reader.runs != [range(len(reader))]:
        there = " and ".join(f"{run.start} to {run.stop - 1}" for run in reader.runs)
        print_lines(Console(stderr=True), f"The stream has frames {there}; those that are lost are left out.")
    write_pictures(output, pictures, fps=reader.header.fps, shown=reader if in_step else None)
    print_lines(Console(), f"Wrote {output}")


def write_pictures(
    output: Path, pictures: "Iterable[NDArray[np.uint8]]", *, fps: float, shown: "StreamReader | None" = None
) -> None:
    """Writes pictures as a video, one PNG or a folder of PNGs, by the suffix of ``output``.

    Args:
        shown: the stream whose frames the pictures show, one after the other; files get their numbers, a video gets
            their times and its sound.
    """
    from structgstream.data.sound import SoundDecoder
    from structgstream.data.video_writer import VideoWriter
    from structgstream.evaluation.pictures import write_png

    frames = zip(count(), repeat(0.0)) if shown is None else _shown_frames(shown)
    with Console(stderr=True).status("rendering") as status:
        if output.suffix.lower() == ".mp4":
            format = None if shown is None else shown.header.sound
            decoder = None if format is None else SoundDecoder(format.channels)
            with VideoWriter(output, fps=fps, channels=None if format is None else format.channels) as video:
                for (number, start), picture in zip(frames, pictures):
                    if shown is None:
                        video.write(picture)
                    else:
                        video.write(picture, seconds=shown.packets.at(number).pts_seconds - start)
                        if decoder is not None and (sound := shown.sound(number)) is not None:
                            samples = decoder.decode(sound.packets, sound.seconds)
                            video.write_sound(samples, seconds=sound.seconds - start)
                    status.update(f"rendering picture {number + 1}")
            return
        for (number, _), picture in zip(frames, pictures):
            write_png(output if output.suffix.lower() == ".png" else output / f"{number:05d}.png", picture)
            status.update(f"rendering picture {number + 1}")


def camera_pictures(
    reader: "StreamReader", backend: "Backend", *, camera: str, frame: int | None = None
) -> "Iterator[NDArray[np.uint8]]":
    """Renderings of a camera of the rig, frame by frame."""
    from structgstream.evaluation.evaluate import rendered
    from structgstream.scene.state import on_device

    view = reader.header.camera(camera)
    for scene in scenes_of(reader, frame):
        yield rendered(on_device(scene, backend.device), view, backend)[0]


def path_pictures(
    reader: "StreamReader",
    backend: "Backend",
    *,
    path: Literal["orbit", "arc"],
    camera: str | None = None,
    between: tuple[str, str] | None = None,
    seconds: float | None = None,
    frame: int | None = None,
) -> "Iterator[NDArray[np.uint8]]":
    """Renderings of a moving camera: a picture for each frame, where the camera is at its time; a stream shorter than
    the path is played slowed, forward and backward, with a picture for each view."""
    from structgstream.evaluation.camera_path import arc, orbit
    from structgstream.evaluation.evaluate import rendered
    from structgstream.scene.state import on_device

    rig, count = reader.header.rig, path_length(reader, seconds)
    views = orbit(rig, count, around=camera) if path == "orbit" else arc(rig, count, between=between)
    for view, scene in _along(reader, views, frame):
        yield rendered(on_device(scene, backend.device), reader.header.camera(view), backend)[0]


def path_length(reader: "StreamReader", seconds: float | None) -> int:
    """The number of views of a camera path of this duration, at the stream's rate; None: the stream's own duration, at
    least :data:`MIN_PATH_SECONDS`."""
    length = max(_seconds(reader, *reader.runs), MIN_PATH_SECONDS) if seconds is None else seconds
    return max(round(length * reader.header.fps), 1)


def is_in_step(reader: "StreamReader", count: int) -> bool:
    """Whether the stream lasts at least as long as a path of ``count`` views, which then shows it at normal speed."""
    return round(_seconds(reader, *reader.runs) * reader.header.fps) >= count


def compared_pictures(
    reader: "StreamReader", scene: Path, *, backend: "Backend", options: Render
) -> "Iterator[NDArray[np.uint8]]":
    """Truth, rendering and difference of a camera, frame by frame."""
    from structgstream.evaluation.evaluate import compared_frames
    from structgstream.evaluation.pictures import side_by_side
    from structgstream.evaluation.recording import capture_of

    camera = choose_camera(reader, options.camera)
    if (options.frame or 0) >= len(reader.packets):
        raise UsageError(
            f"--compare shows the frames before the first lost one, which is frame {len(reader.packets)}; without it "
            "render reaches all that are there."
        )
    source = capture_of(reader.header, scene, frames=len(reader.packets))
    pairs = compared_frames(reader, source, backend=backend, camera=camera)
    if options.frame is not None:
        pairs = islice(pairs, options.frame, options.frame + 1)
    yield from starmap(side_by_side, pairs)


def choose_camera(reader: "StreamReader", camera: str | None) -> str:
    """The named camera, the first held-out one, or the one in the middle of the rig."""
    from structgstream.evaluation.camera_path import central_camera

    rig = reader.header.rig
    if camera is None:
        return rig.testing[0] if rig.testing else central_camera(rig)
    if camera not in rig.cameras:
        raise UsageError(f"the stream has no camera {camera!r}; it has {', '.join(rig)}.")
    return camera


def scenes_of(reader: "StreamReader", frame: int | None) -> "Iterator[Scene]":
    """The scenes of all frames that can be decoded, or that of one frame."""
    for run in reader.runs if frame is None else [range(frame, frame + 1)]:
        yield from map(reader.scene, run)


def default_output(options: Render, reader: "StreamReader") -> Path:
    """``ball.sgs`` gives ``ball-orbit.mp4``, ``ball-10.mp4`` or ``ball-10-compare.mp4``."""
    name = options.path or choose_camera(reader, options.camera)
    ending = "-compare" if options.compare else ""
    still = options.frame is not None and options.path is None
    suffix = f"-{options.frame}.png" if still else ".mp4"
    return side_path(options.stream, f"-{name}{ending}{suffix}")


def _along(reader: "StreamReader", views: "Sequence[Camera]", frame: int | None) -> "Iterator[tuple[Camera, Scene]]":
    """The views of a path, which are a frame's distance apart, with the scenes that they show."""
    count = len(views)
    if frame is None and is_in_step(reader, count):
        for number, start in _shown_frames(reader):
            place = round((reader.packets.at(number).pts_seconds - start) * reader.header.fps)
            if place >= count:
                return
            yield views[place], reader.scene(number)
        return
    # A stream shorter than the path fits in memory: its scenes share static fields.
    scenes = list(scenes_of(reader, frame))
    for number, view in enumerate(views):
        yield view, scenes[round((len(scenes) - 1) * (1.0 - abs(1.0 - 2.0 * number / count)))]


def _shown_frames(reader: "StreamReader") -> "Iterator[tuple[int, float]]":
    """The frames that can be decoded, each with the presentation time at which its video begins, seconds. Lost frames
    are left out with their time, which can be hours where they have left a stream's window."""
    before = 0.0
    for run in reader.runs:
        start = reader.packets.at(run.start).pts_seconds - before
        yield from zip(run, repeat(start))
        before += _seconds(reader, run)


def _seconds(reader: "StreamReader", *runs: range) -> float:
    """How long the stream shows the frames of these runs."""
    from structgstream.evaluation.byte_count import shown_seconds

    ends = ([reader.packets.at(run.start), reader.packets.at(run.stop - 1)] for run in runs)
    return sum(shown_seconds(two, reader.header.fps) for two in ends)
