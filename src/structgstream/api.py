# SPDX-License-Identifier: Apache-2.0
"""The functions of ``import structgstream``: prepare and reconstruct a capture, evaluate a stream, export a stream.

Each does what the command of the same name does by default, without output to the terminal. Cameras and points are in
the units of the capture.
"""

import math
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Literal

from structgstream.codec.reader import open_stream
from structgstream.codec.segments.sink import SegmentsOptions
from structgstream.data.dataset_layouts import bundled_clip_path
from structgstream.data.open import open_capture
from structgstream.data.sound import SoundSource
from structgstream.data.source import FrameSource, FrameStream
from structgstream.errors import ConfigError
from structgstream.evaluation.evaluate import evaluate as evaluate_recording
from structgstream.evaluation.optional_metrics import MetricSelection
from structgstream.evaluation.recording import captures_of, check_has_first_frame, part_metadata
from structgstream.evaluation.report import Report
from structgstream.evaluation.run_log import log_of
from structgstream.exporters.formats import Format, FrameOptions, PageFormat, check_page, choose_frames, destination
from structgstream.exporters.write import write_frames
from structgstream.kernels.backend import Backend, BackendName, select_backend
from structgstream.preparation.checking.check import CheckReport
from structgstream.preparation.options import PrepareOptions
from structgstream.preparation.output_folder import Listener
from structgstream.preparation.prepare import Preparation, check_folder, prepare_capture
from structgstream.preparation.sound import chosen_sound
from structgstream.recorder import check_output, record, segments_at, segments_folder
from structgstream.serve.pages import StreamFile, write_page, write_site
from structgstream.session.frame_report import FrameReport
from structgstream.session.presets import DEFAULT_PRESET, StreamConfig, preset_named, with_budget
from structgstream.session.struct_gstream import stream_pipeline


def example_clip() -> Path:
    """The folder of the bundled example capture: 10 cameras, 12 frames of 320x240.

    Raises:
        CaptureError: the installation lacks the clip.
    """
    return bundled_clip_path()


def prepare(
    videos: Path | str, capture: Path | str, *, options: PrepareOptions | None = None, listener: Listener | None = None
) -> Preparation:
    """Turns videos of static cameras into a calibrated capture, and checks it.

    The call can be repeated: steps with unchanged inputs and options are skipped, so it resumes after an interruption.

    Args:
        videos: the folder of the cameras' videos or pictures.
        capture: the folder to make; a folder with other files is refused.
        options: options of the steps; None for the defaults of the command.
        listener: receives steps and progress.

    Returns:
        the capture's folder, the result of the check, and the page of its report.

    Raises:
        CaptureError: the videos cannot be read, synchronised or calibrated, or ``capture`` contains other files.
        ConfigError: the options are not possible with these cameras.
        StorageError: the capture cannot be written.
        MissingExtraError: a package that a step needs is not installed.
    """
    return prepare_capture(Path(videos), Path(capture), options=options, listener=listener)


def check(capture: Path | str, *, report: Path | str | None = None) -> CheckReport:
    """Checks a capture of any layout against its pictures: poses, names, units, overlap, colours, times.

    Args:
        capture: the folder of the capture.
        report: folder for a page with pictures and numbers; None for none.

    Returns:
        all measurements, and findings with errors first.

    Raises:
        CaptureError: the capture cannot be opened or read.
        StorageError: the report cannot be written.
        MissingExtraError: a package is not installed.
    """
    return check_folder(Path(capture), report=None if report is None else Path(report)).report


def reconstruct(
    capture: FrameStream | Path | str,
    path: Path | str,
    *,
    preset: StreamConfig | str = DEFAULT_PRESET,
    quality: float | None = None,
    mbits: float | None = None,
    seed: int | None = None,
    held_out: tuple[str, ...] | Literal["auto"] | None = None,
    scale: float = 1.0,
    start: int = 0,
    frames: int | None = None,
    near: float | None = None,
    every: int = 1,
    roving: bool = True,
    backend: Backend | BackendName = "auto",
    resume: bool = False,
    overwrite: bool = False,
    sink: Literal["file", "segments"] = "file",
    window_seconds: float | None = None,
    sound: str | SoundSource | None = None,
    sound_offset: float | None = None,
    on_frame: Callable[[FrameReport], object] | None = None,
) -> list[FrameReport]:
    """Reconstructs a capture to a stream file, frame by frame; returns after the last frame is stored.

    A frame is on the disk before ``on_frame`` is called. After an interruption the same call with ``resume`` continues
    after the last complete frame and gives the same bytes. The log next to the stream, ``OUT.log.jsonl``, has seconds
    by stage and memory of each frame.

    Args:
        capture: the folder of a capture, or an opened one, such as a ``LiveSource``, which is read until it ends.
        path: the stream file to write; the folder, if it is written as segments.
        preset: name of a preset, or a configuration (``dataclasses.replace`` on one of ``PRESETS``).
        quality: for compact streams, -6 to 6: quantization steps are multiplied by 2^-quality, those of frame 0 and of
            the MLPs by 2^(-quality / 2).
        mbits: for compact streams, target rate in Mbit/s; None for constant quality.
        seed: random seed; None for the preset's.
        held_out: names of the cameras to exclude from training; None for those that the capture's layout holds out;
            "auto" for the one best surrounded by others.
        scale: size of the pictures relative to the stored ones, in (0, 1].
        start: first frame to use.
        frames: number of frames; None for all.
        near: distance of the near plane, in units of the capture; None for the capture's own.
        every: step between used frames; the frame rate is divided by it.
        roving: whether frame 0 is trained on a capture's roving pictures, too, where ``prepare`` registered some.
        backend: the compute back-end; ``auto`` takes the first available of cuda, cpu, reference.
        resume: continue after the last complete frame of ``path``.
        overwrite: replace ``path`` if it exists.
        sink: ``segments`` writes a folder of immutable files and a manifest (docs/segments.md).
        window_seconds: for segments, how far viewers can seek back; None stores everything.
        sound: name of a camera or a file whose sound is stored; ``auto`` for the best microphone, ``none``; None for
            the one that ``prepare`` chose. Of an opened capture, a :class:`SoundSource`.
        sound_offset: when the file of ``sound`` begins, in seconds after the first frame of the capture; None to find
            it out by what cameras hear.
        on_frame: called with the report of each frame.

    Returns:
        a report of each frame that this call reconstructed.

    Raises:
        CaptureError: the capture cannot be read, or contradicts itself.
        ConfigError: arguments are invalid, or differ from those of the stream to resume.
        StorageError: ``path`` exists without ``resume`` or ``overwrite``, or cannot be written.
        StreamError: the file to resume is not a stream.
        BackendError: the back-end is not available.
    """
    if resume and overwrite:
        raise ConfigError("resume continues the file and overwrite replaces it: choose one.")
    if sink not in ("file", "segments"):
        raise ConfigError(f"sink is 'file' or 'segments'; got {sink!r}.")
    if not isinstance(preset, StreamConfig | str):
        raise ConfigError(f"preset is a name or a StreamConfig, such as PRESETS['compact']; got {preset!r}.")
    if window_seconds is not None and not (sink == "segments" and 0.0 < window_seconds < math.inf):
        raise ConfigError(
            f"window_seconds is a positive number of seconds, for sink='segments'; got {window_seconds:g} for "
            f"sink={sink!r}."
        )
    named = preset if isinstance(preset, str) else None
    config = with_budget(
        preset_named(preset) if isinstance(preset, str) else preset, name=named, quality=quality, mbits=mbits
    )
    if seed is not None:
        config = replace(config, seed=seed)
    metadata: dict[str, object] = {} if named is None else {"preset": named}
    if isinstance(capture, Path | str):
        source = open_capture(
            capture,
            held_out=held_out,
            scale=scale,
            start=start,
            frames=frames,
            near=near,
            every=every,
            roving=roving,
        )
        metadata |= part_metadata(start=start, scale=scale, every=every)
        if sound is None or isinstance(sound, str):
            sound = chosen_sound(source, Path(capture), sound, offset_seconds=sound_offset)
    elif (held_out, scale, start, frames, near, every, roving) != (None, 1.0, 0, None, None, 1, True):
        raise ConfigError(
            "held_out, scale, start, frames, near, every and roving choose from a folder; an opened capture was given, "
            "for which open_capture takes them."
        )
    elif isinstance(sound, str) or sound_offset is not None:
        raise ConfigError("sound and sound_offset choose from a folder; an opened capture takes a SoundSource.")
    else:
        source = capture
    pipeline, chosen = stream_pipeline(config), select_backend(backend)
    # Opened last, because it creates a folder and a lock.
    path = Path(path)
    storage = None
    if sink == "segments":
        store = segments_folder(path, may_exist=resume or overwrite)
        storage = segments_at(store, options=SegmentsOptions(window_seconds))
    else:
        check_output(path, may_exist=resume or overwrite)
    run = record(path, source, pipeline, chosen, resume=resume, storage=storage, metadata=metadata, sound=sound)
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
    """Evaluates a stream file against the capture's pictures.

    Args:
        path: the stream file.
        capture: the folder of the stream's capture, or that capture opened with the same arguments.
            Scores at the size of larger stored pictures need the folder.
        cameras: names of the cameras to score; None for the held-out ones.
        metrics: ``basic`` leaves out MS-SSIM, FLIP, LPIPS and the temporal metrics.
        lpips_weights: folder or file with the weights of LPIPS; None for the default locations.
        backend: the compute back-end.

    Returns:
        the report: a mean over all frames and cameras, and scores by frame and by camera.

    Raises:
        StreamError: the file is not a stream, or is damaged.
        CaptureError: the capture is not that of the stream.
        ConfigError: there is no camera or frame to score.
        BackendError: the back-end is not available.
    """
    with open_stream(path) as reader:
        check_has_first_frame(reader)
        stored = None
        if isinstance(capture, Path | str):
            capture, stored = captures_of(reader.header, capture, frames=len(reader.packets))
        return evaluate_recording(
            reader,
            capture,
            backend=select_backend(backend),
            cameras=cameras,
            log=log_of(Path(path), {info.index: info.bytes for info in reader.packets}),
            metrics=metrics,
            lpips_weights=lpips_weights,
            stored=stored,
        )


def export(
    path: Path | str,
    output: Path | str | None = None,
    *,
    format: Format | PageFormat | None = None,
    frame: int | None = None,
    frames: tuple[int, int] | None = None,
    options: FrameOptions | None = None,
    backend: Backend | BackendName = "auto",
) -> Path:
    """Writes a stream as a page with a player, or its frames as plain 3D Gaussians for other programs.

    Args:
        path: the stream file.
        output: where to write: ``NAME.html`` is one page that plays the stream; ``NAME.ply``, ``.splat``, ``.spz``,
            ``.sog`` and ``.glb`` are one frame; ``NAME.usd`` and ``.4dgs`` contain all frames; ``NAME.zip`` is a zip of
            frames; any other name is a folder. None for a file or a folder next to the stream.
        format: format of the output; None for the suffix of ``output``, else ``ply``. ``site`` is a folder for a web
            server.
        frame: the only frame to write.
        frames: the first and the last frame to write; None for all.
        options: degree of the spherical harmonics, which Gaussians are left out, details of a format; None for the
            defaults (docs/export.md).
        backend: evaluates the MLPs.

    Returns:
        the file or the folder. Units of plain Gaussians are the capture's own, axes, too (``.spz``, ``.glb``,
            ``.usd`` and ``.4dgs``: y up, z back).

    Raises:
        ConfigError: arguments contradict each other, or a frame does not exist.
        StreamError: the file is not a stream, or none of its frames can be decoded.
        StorageError: a file cannot be written.
        PlayerError: the stream is too long for a page.
        BackendError: the back-end is not available.
        MissingExtraError: a package of the format is not installed.
    """
    path = Path(path)
    target, chosen = destination(
        path, None if output is None else Path(output), format=format, frame=frame, frames=frames
    )
    options = options or FrameOptions()
    if chosen == "html" or chosen == "site":
        check_page(frame=frame, frames=frames, options=options)
        write = write_page if chosen == "html" else write_site
        write(target, StreamFile(path))
        return target
    options.check(chosen)
    with open_stream(path, by_index=frame is not None) as reader:
        numbers = choose_frames(reader.runs, target, frame=frame, frames=frames)
        kind = select_backend(backend)
        for _ in write_frames(reader, numbers, target, format=chosen, backend=kind, options=options):
            pass
    return target
