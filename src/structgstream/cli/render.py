# SPDX-License-Identifier: Apache-2.0
"""``structgstream render``."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro
from rich.console import Console

from structgstream.cli.app import UsageError
from structgstream.cli.options import Device, Flag, StreamFile, check_ending, parse_options
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
    scene: Annotated[tyro.conf.Positional[Path | None], tyro.conf.arg(metavar="[FOLDER]", help_behavior_hint="")] = None
    """The capture, for --compare."""
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"], metavar="OUT", help_behavior_hint="")] = None
    """Output file or folder. Default: a video next to the stream, named after the camera or the path."""
    camera: Annotated[str | None, tyro.conf.arg(metavar="CAMERA", help_behavior_hint="")] = None
    """A camera of the rig; with --path orbit, the one to circle. Default: the first held-out one."""
    path: Annotated[Literal["orbit", "arc"] | None, tyro.conf.arg(help_behavior_hint="")] = None
    """Camera path: an orbit around one camera, or an arc from one camera to another."""
    between: Annotated[tuple[str, str] | None, tyro.conf.arg(metavar="CAMERA CAMERA", help_behavior_hint="")] = None
    """Ends of the arc. Default: two cameras well apart on the same side."""
    seconds: Annotated[float | None, tyro.conf.arg(help_behavior_hint="")] = None
    """Duration of the path. Default: the stream's, at least 4 s; a shorter stream is played slowed, back and forth."""
    frame: Annotated[int | None, tyro.conf.arg(metavar="N", help_behavior_hint="")] = None
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
    from structgstream.kernels.backend import select_backend

    reader = open_stream(options.stream, by_index=options.frame is not None)
    output = options.output or default_output(options, reader)
    if output.suffix.lower() == ".png" and options.frame is None:
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
    if output.suffix.lower() == ".png":
        pictures = islice(pictures, 1)
    has_sound = output.suffix.lower() == ".mp4" and reader.header.sound is not None
    in_step = options.frame is None and (options.path is None or path_length(reader, options.seconds) <= len(reader))
    if has_sound and not in_step:
        print_lines(Console(stderr=True), "The video has no sound, because it does not show the stream as it is.")
    write_pictures(output, pictures, fps=reader.header.fps, heard=reader if has_sound and in_step else None)
    print_lines(Console(), f"Wrote {output}")


def write_pictures(
    output: Path, pictures: "Iterable[NDArray[np.uint8]]", *, fps: float, heard: "StreamReader | None" = None
) -> None:
    """Writes pictures as a video, one PNG or a folder of PNGs, by the suffix of ``output``.

    Args:
        heard: the stream whose frames the pictures show, one after the other; a video gets its sound and its times.
    """
    from structgstream.data.sound import SoundDecoder
    from structgstream.data.video_writer import VideoWriter
    from structgstream.evaluation.pictures import write_png

    with Console(stderr=True).status("rendering") as status:
        if output.suffix.lower() == ".mp4":
            format = None if heard is None else heard.header.sound
            decoder = None if format is None else SoundDecoder(format.channels)
            with VideoWriter(output, fps=fps, channels=None if format is None else format.channels) as video:
                for number, picture in enumerate(pictures):
                    if heard is None or decoder is None:
                        video.write(picture)
                    else:
                        start = heard.packets[0].pts_seconds
                        video.write(picture, seconds=heard.packets[number].pts_seconds - start)
                        if (sound := heard.sound(number)) is not None:
                            samples = decoder.decode(sound.packets, sound.seconds)
                            video.write_sound(samples, seconds=sound.seconds - start)
                    status.update(f"rendering picture {number + 1}")
            return
        for number, picture in enumerate(pictures):
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
    """Renderings of a moving camera; a stream shorter than the path is played slowed, forward and backward."""
    from structgstream.evaluation.camera_path import arc, orbit
    from structgstream.evaluation.evaluate import rendered
    from structgstream.scene.state import on_device

    header = reader.header
    count = path_length(reader, seconds)
    rig = header.rig
    views: list[Camera] = orbit(rig, count, around=camera) if path == "orbit" else arc(rig, count, between=between)
    for view, scene in zip(views, _ping_pong(reader, frame, count=count), strict=True):
        yield rendered(on_device(scene, backend.device), header.camera(view), backend)[0]


def path_length(reader: "StreamReader", seconds: float | None) -> int:
    """The pictures of a camera path of this duration; None: the stream's, or a little longer."""
    length = max(len(reader.packets) / reader.header.fps, MIN_PATH_SECONDS) if seconds is None else seconds
    return max(round(length * reader.header.fps), 1)


def compared_pictures(
    reader: "StreamReader", scene: Path, *, backend: "Backend", options: Render
) -> "Iterator[NDArray[np.uint8]]":
    """Truth, rendering and difference of a camera, frame by frame."""
    from structgstream.evaluation.evaluate import compared_frames
    from structgstream.evaluation.pictures import side_by_side
    from structgstream.evaluation.recording import capture_of

    camera = choose_camera(reader, options.camera)
    _check_frame(reader, options.frame)
    pairs = compared_frames(
        reader, capture_of(reader.header, scene, frames=len(reader.packets)), backend=backend, camera=camera
    )
    for number, (truth, picture) in enumerate(pairs):
        if options.frame is None or number == options.frame:
            yield side_by_side(truth, picture)
        if number == options.frame:
            return


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
    """All decoded scenes, or that of one frame."""
    _check_frame(reader, frame)
    if frame is not None:
        yield reader.scene(frame)
        return
    for _, scene in reader.scenes(0):
        yield scene


def default_output(options: Render, reader: "StreamReader") -> Path:
    """``ball.sgs`` gives ``ball-orbit.mp4``, ``ball-10.mp4`` or ``ball-10-compare.mp4``."""
    name = options.path or choose_camera(reader, options.camera)
    ending = "-compare" if options.compare else ""
    still = options.frame is not None and options.path is None
    suffix = f"-{options.frame}.png" if still else ".mp4"
    return options.stream.with_name(f"{options.stream.stem}-{name}{ending}{suffix}")


def _ping_pong(reader: "StreamReader", frame: int | None, *, count: int) -> "Iterator[Scene]":
    if frame is None and len(reader.packets) >= count:
        yield from islice(scenes_of(reader, None), count)
        return
    # A stream shorter than the path fits in memory: its scenes share static fields.
    scenes = list(scenes_of(reader, frame))
    for number in range(count):
        yield scenes[round((len(scenes) - 1) * (1.0 - abs(1.0 - 2.0 * number / count)))]


def _check_frame(reader: "StreamReader", frame: int | None) -> None:
    if frame is not None and not 0 <= frame < len(reader.packets):
        raise UsageError(f"the stream has frames 0 to {len(reader.packets) - 1}; there is no frame {frame}.")
