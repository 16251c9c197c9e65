# SPDX-License-Identifier: Apache-2.0
"""What a program asks for: a capture as a stream, a stream's scores, and a stream in other formats.

Each function is one command of ``structgstream`` with its defaults, without its display; cameras, points and rates are
in the units of the capture. The names are those of ``import structgstream``.
"""

from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path

from structgstream.codec.reader import open_stream
from structgstream.data.open import open_capture
from structgstream.data.source import FrameSource
from structgstream.errors import ConfigError
from structgstream.evaluation.capture import capture_of
from structgstream.evaluation.evaluate import evaluate as evaluate_recording
from structgstream.evaluation.optional_metrics import MetricSelection
from structgstream.evaluation.report import Report
from structgstream.evaluation.run_log import read_log
from structgstream.exporters.formats import Format, PageFormat
from structgstream.exporters.frames import write_frames
from structgstream.exporters.request import check_degree, check_page, choose_frames, destination
from structgstream.frame_report import FrameReport
from structgstream.kernels.backend import Backend, BackendName, select_backend
from structgstream.player.stream_file import StreamFile
from structgstream.player.write import write_page, write_site
from structgstream.presets import DEFAULT_PRESET, StreamConfig, preset_named, with_budget
from structgstream.recorder import check_output, record
from structgstream.struct_gstream import stream_pipeline


def reconstruct(
    capture: FrameSource | Path | str,
    path: Path | str,
    *,
    preset: StreamConfig | str = DEFAULT_PRESET,
    quality: float | None = None,
    mbits: float | None = None,
    seed: int | None = None,
    held_out: tuple[str, ...] | None = None,
    scale: float = 1.0,
    start: int = 0,
    frames: int | None = None,
    near: float | None = None,
    backend: Backend | BackendName = "auto",
    resume: bool = False,
    overwrite: bool = False,
    on_frame: Callable[[FrameReport], object] | None = None,
) -> list[FrameReport]:
    """Turns a capture into a stream file, frame by frame, and returns when the last frame is stored.

    Every frame is on the disk when ``on_frame`` is told of it. Whatever ends the call, Ctrl-C too, whole frames stay,
    and the same call with ``resume`` goes on after them to the same bytes. Seconds by stage and memory of each frame
    are in the log beside the stream, ``OUT.log.jsonl``.

    Args:
        capture: the folder of a capture, or an opened one.
        path: the stream file to write.
        preset: name of a preset, or a configuration (``dataclasses.replace`` on one of ``PRESETS``).
        quality: of compact streams, -6 to 6: 0 is the preset's own, 1 makes every step half as large, -1 twice as
            large.
        mbits: of compact streams: the rate to keep to, in Mbit/s; None for constant quality.
        seed: of everything random; None for the preset's.
        held_out: names of the cameras to keep from training; None for those that the capture's layout holds out.
        scale: size of the pictures relative to the stored ones, in (0, 1].
        start: first frame to use.
        frames: number of frames; None for all.
        near: nothing nearer to a camera is drawn, in units of the capture; None for the capture's own.
        backend: what computes; ``auto`` takes the first of cuda, cpu and reference that there is.
        resume: go on after the last whole frame of ``path``.
        overwrite: replace ``path`` when it exists.
        on_frame: told of each frame.

    Returns:
        a report of each frame that was reconstructed in this call.

    Raises:
        CaptureError: the capture cannot be read, or contradicts itself.
        ConfigError: arguments that cannot work, or a stream to resume that was made with others.
        StorageError: ``path`` exists and is neither to be resumed nor to be replaced, or cannot be written.
        StreamError: what is to be resumed is no stream.
        BackendError: the back-end is not available.
    """
    if resume and overwrite:
        raise ConfigError("resume keeps the file and overwrite replaces it: choose one.")
    named = preset if isinstance(preset, str) else None
    config = with_budget(
        preset_named(preset) if isinstance(preset, str) else preset, name=named, quality=quality, mbits=mbits
    )
    if seed is not None:
        config = replace(config, seed=seed)
    path = Path(path)
    check_output(path, may_exist=resume or overwrite)
    metadata: dict[str, object] = {} if named is None else {"preset": named}
    if isinstance(capture, Path | str):
        source = open_capture(capture, held_out=held_out, scale=scale, start=start, frames=frames, near=near)
        metadata |= {"start": start, "scale": scale}
    elif (held_out, scale, start, frames, near) != (None, 1.0, 0, None, None):
        raise ConfigError(
            "held_out, scale, start, frames and near choose from a folder; an opened capture was given, for which "
            "open_capture takes them."
        )
    else:
        source = capture
    run = record(path, source, stream_pipeline(config), select_backend(backend), resume=resume, metadata=metadata)
    reports = []
    with closing(run.reports) as recording:
        for report in recording:
            reports.append(report)
            if on_frame is not None:
                on_frame(report)
    return reports


def evaluate(
    path: Path | str,
    capture: FrameSource | Path | str,
    *,
    cameras: tuple[str, ...] | None = None,
    metrics: MetricSelection = "all",
    lpips_weights: Path | None = None,
    backend: Backend | BackendName = "auto",
) -> Report:
    """Scores a stream file against what cameras took; everything is decoded from the file.

    Args:
        path: the stream file.
        capture: the folder of the capture that it was made from, or this capture, opened as it was then.
        cameras: names of the cameras to score; None for those that training did not see.
        metrics: ``basic`` leaves out MS-SSIM, FLIP, LPIPS and the scores over time.
        lpips_weights: folder or file with the weights that LPIPS needs; None for the usual places.
        backend: what renders.

    Returns:
        the report, with a mean over all frames and cameras, and scores by frame and by camera.

    Raises:
        StreamError: the file is no stream, or damaged.
        CaptureError: the capture is not the one of the stream.
        ConfigError: there is no camera to score.
        BackendError: the back-end is not available.
    """
    with open_stream(path) as reader:
        if isinstance(capture, Path | str):
            capture = capture_of(reader.header, capture, frames=len(reader.packets))
        return evaluate_recording(
            reader,
            capture,
            backend=select_backend(backend),
            cameras=cameras,
            log=read_log(Path(path)),
            metrics=metrics,
            lpips_weights=lpips_weights,
        )


def export(
    path: Path | str,
    output: Path | str | None = None,
    *,
    format: Format | PageFormat | None = None,
    frame: int | None = None,
    frames: tuple[int, int] | None = None,
    sh_degree: int | None = None,
    backend: Backend | BackendName = "auto",
) -> Path:
    """Writes a stream as a page with a player, or its frames as plain 3D Gaussians for other programs.

    Args:
        path: the stream file.
        output: where to write: ``NAME.html`` is one page that plays the stream; ``NAME.ply``, ``NAME.splat`` and
            ``NAME.spz`` are one frame; any other name is a folder. None for a file or a folder beside the stream.
        format: of what is written; None for what the name of ``output`` says, else ``ply``. ``site`` is a folder for a
            web server.
        frame: the only frame to write.
        frames: the first and the last frame to write; None for all.
        sh_degree: degree of the spherical harmonics, 0 to 2; None for 1, and 0 in a ``.splat``, which has none.
        backend: what evaluates the MLPs.

    Returns:
        the file or the folder. Units and axes of plain Gaussians are the capture's own (``.spz``: y up, z back).

    Raises:
        ConfigError: wishes that contradict each other, or a frame that is not there.
        StreamError: the file is no stream, or nothing of it can be shown.
        StorageError: something cannot be written.
        PlayerError: the stream is too long for a page.
        BackendError: the back-end is not available.
    """
    path = Path(path)
    target, chosen = destination(
        path, None if output is None else Path(output), format=format, frame=frame, frames=frames
    )
    if chosen == "html" or chosen == "site":
        check_page(frame=frame, frames=frames, sh_degree=sh_degree)
        write = write_page if chosen == "html" else write_site
        write(target, StreamFile(path))
        return target
    degree = check_degree(sh_degree, chosen)
    with open_stream(path, by_index=frame is not None) as reader:
        numbers = choose_frames(reader.runs, target, frame=frame, frames=frames)
        for _ in write_frames(reader, numbers, target, format=chosen, backend=select_backend(backend), degree=degree):
            pass
    return target
