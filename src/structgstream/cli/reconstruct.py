# SPDX-License-Identifier: Apache-2.0
"""``structgstream reconstruct``, also into several qualities."""

import argparse
import shutil
import signal
import sys
from collections.abc import Callable, Mapping
from contextlib import closing, nullcontext
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro
from rich.console import Console

from structgstream.cli.app import StopSignal, UsageError, interruption, usage_errors
from structgstream.cli.live_run import LiveChoice, monitored, open_live, run_metrics
from structgstream.cli.options import (
    CaptureOptions,
    Device,
    Flag,
    Folder,
    Number,
    PresetName,
    SegmentOptions,
    StreamOutput,
    check_ending,
    config_lines,
    open_selected_capture,
    parse_known_options,
    resolve_config,
    shown_as,
)
from structgstream.cli.progress import human_bytes, print_lines

if TYPE_CHECKING:
    from structgstream.codec.segments.sink import Clocks
    from structgstream.data.sound import SoundSource
    from structgstream.data.source import FrameStream
    from structgstream.kernels.backend import Backend
    from structgstream.recorder import Run, RunMetrics, Storage
    from structgstream.scene.scene import Scene
    from structgstream.session.presets import StreamConfig


@dataclass(frozen=True)
class Reconstruct:
    """Turns a capture into a stream, one frame after the other.

    The file can be read while it grows: structgstream play OUT.sgs --wait shows each frame when it is done. After
    Ctrl-C, --resume continues after the last whole frame; SIGTERM finishes the frame first (status 143). Seconds by
    stage and memory of each frame are written to OUT.log.jsonl. Any field of the configuration is an option by its
    path: --online.iterations 50 (see --help-config).

    Example: structgstream reconstruct basketball -o ball.sgs --frames 20 --held-out 0 10 15 30

    Example: structgstream reconstruct basketball -o ball.sgs --preset fast --scale 0.5 --online.iterations 40

    Example: structgstream reconstruct basketball -o ball.sgs --mbits 5

    Example: structgstream reconstruct basketball -o ball --sink segments --window 600

    Example: structgstream reconstruct rig.toml -o now.sgs --live --preset fast --record take1

    Example: structgstream reconstruct rig.toml -o now --live --sink segments --qualities low=-1 high=1
    """

    scene: tyro.conf.Positional[Folder]
    """The capture: a folder of pictures or videos with their calibration, as docs/captures.md lists them; with --live
    the rig file of cameras that send now (docs/live.md)."""
    output: StreamOutput
    """The stream file to write; with --sink segments, a folder."""
    preset: PresetName = None
    """compact (default: small packets), fine (compact with twice the iterations), fast (compact in minutes), rig (the
    paper on any rig), motion (as rig, trains only what moves), paper-n3dv, paper-meetroom, paper-immersive, tiny (for
    tests)."""
    quality: Annotated[float | None, shown_as("Q")] = None
    """Compact streams only: 0 is the preset's quality, 1 halves every quantization step, -1 doubles it; from -6 to
    6."""
    mbits: Annotated[float | None, shown_as("R")] = None
    """Compact streams only: target rate in Mbit/s over every second, without the header. Default: constant quality."""
    qualities: Annotated[tuple[str, ...] | None, shown_as("NAME=Q NAME=Q [NAME=Q ...]")] = None
    """Several qualities of the same frames, each a folder OUT/NAME of segments with --quality Q, and a list from which
    players choose (docs/live.md). With --sink segments."""
    device: Device = "auto"
    """Compute back-end; auto takes the first available of cuda, cpu and reference (plain PyTorch, slow)."""
    seed: Number = None
    """Random seed. Default: the preset's."""
    sound: Annotated[str | None, shown_as("CAMERA|FILE|auto|none")] = None
    """Sound to store with the frames: that of a camera, in step by its clock; a file, in step by what cameras hear of
    it; auto for the best microphone. Default: the microphone that prepare chose, otherwise none. Live: a camera."""
    sound_offset: Annotated[float | None, shown_as("SECONDS")] = None
    """When the file of --sound begins, in seconds after the first frame of the capture. Default: found by what cameras
    hear."""
    resume: Flag = False
    """Continue after the last whole frame of OUT. The same options give the bytes of an uninterrupted run."""
    overwrite: Flag = False
    """Replace OUT when it exists."""
    help_config: Flag = False
    """List the fields of the configuration with the preset's values."""
    capture: CaptureOptions = field(default_factory=CaptureOptions)
    segments: SegmentOptions = field(default_factory=SegmentOptions)
    live: LiveChoice = field(default_factory=LiveChoice)


def main(arguments: list[str]) -> None:
    """Reconstructs with a progress display."""
    if "--help-config" in arguments:
        _print_config(arguments)
        return
    options, rest = parse_known_options(Reconstruct, "reconstruct", arguments=arguments)
    check_ending(options.output, ".sgs", command="reconstruct", folder=True)
    if options.sound_offset is not None:
        if options.sound is None:
            raise UsageError("--sound-offset says when the file of --sound begins; give that, too.")
        if options.live.live:
            raise UsageError("--sound-offset is for files; the sound of a live camera is in step by its clock.")
    if options.resume and options.overwrite:
        raise UsageError("--resume keeps the file and --overwrite replaces it: choose one.")
    config, preset = resolve_config(options.preset, rest, command="reconstruct", seed=options.seed)
    if options.qualities is not None:
        _reconstruct_qualities(options, config, preset=preset)
        return
    from structgstream.session.presets import with_budget

    with usage_errors():
        config = with_budget(config, name=preset, quality=options.quality, mbits=options.mbits)
    console = Console()
    may_exist = options.resume or options.overwrite
    options.segments.chosen(options.output)
    opened = open_scene(options, config, preset=preset, console=console)
    with options.segments.storage(
        options.output, may_exist=may_exist, report=partial(print_lines, console), clocks=opened.clocks
    ) as storage:
        peaks = run_reconstruction(
            opened.source,
            config,
            output=options.output,
            backend=opened.backend,
            metadata=opened.metadata,
            sound=opened.sound,
            resume=options.resume,
            storage=storage,
            metrics=run_metrics(opened.source, options.output),
        )
        if peaks:
            stages = ", ".join(f"{stage} {human_bytes(size)}" for stage, size in peaks.items())
            print_lines(console, f"Peak memory by stage: {stages}.")
    print_lines(console, f"Wrote {options.output}")


@dataclass(frozen=True)
class OpenedScene:
    """What a run reads, and with what it computes."""

    source: "FrameStream"  # a recording, or live cameras
    clocks: "Clocks | None"  # with the times at which live cameras filmed; None for a recording
    backend: "Backend"
    metadata: Mapping[str, object]  # of the run, for headers
    sound: "SoundSource | None"  # to store beside the frames


def open_scene(options: Reconstruct, config: "StreamConfig", *, preset: str, console: Console) -> OpenedScene:
    """The capture, or the live cameras, that the options name; says what it is."""
    from structgstream.codec.segments.sink import Clocks
    from structgstream.data.camera_spacing import expectation
    from structgstream.data.roving import roving_of
    from structgstream.evaluation.recording import part_metadata
    from structgstream.kernels.backend import select_backend
    from structgstream.preparation.sound import chosen_sound
    from structgstream.session.presets import departures
    from structgstream.training.online.select import unrecognized_faults

    if options.live.live:
        source = open_live(
            options.scene,
            options.capture,
            options.live,
            stream=options.output,
            resume=options.resume,
            denoising=config.denoising,
            sound=options.sound,
        )
        length, clocks, sound = "live", Clocks(captured=source.captured), source.sound
    else:
        options.live.check(options.scene)
        source = open_selected_capture(options.scene, options.capture)
        length, clocks = f"{len(source)} frames", None
        if (roving := roving_of(source)) is not None:
            length = f"{length}; {len(roving.pictures)} roving pictures for frame 0"
        sound = chosen_sound(source, options.scene, options.sound, offset_seconds=options.sound_offset)
    backend = select_backend(options.device)
    print_lines(
        console,
        f"{source.name}: {len(source.rig.training)} training cameras, held out: "
        f"{', '.join(source.rig.testing) or 'none'}; {length}; preset {preset}, back-end {backend.name}.",
    )
    if expected := expectation({name: source.rig[name] for name in source.rig.training}):
        print_lines(console, f"{'Warning: ' if expected.poor else ''}{expected.sentence}")
    if differences := departures(preset, source.rig):
        console.print(f"The paper's data of {preset} are others: {'; '.join(differences)}.", highlight=False)
    if config.online.motion.enabled and (blind := unrecognized_faults(len(source.rig.training))) is not None:
        console.print(blind, highlight=False)
    part = part_metadata(start=options.capture.start, scale=options.capture.scale, every=options.capture.every)
    if sound is not None:
        print_lines(console, f"Sound: {sound.name}.")
    return OpenedScene(source, clocks, backend, {"preset": preset, **part}, sound)


def run_reconstruction(
    source: "FrameStream",
    config: "StreamConfig",
    *,
    output: Path,
    backend: "Backend",
    metadata: Mapping[str, object],
    resume: bool = False,
    storage: "Storage[Scene] | None" = None,
    metrics: "RunMetrics | None" = None,
    sound: "SoundSource | None" = None,
) -> dict[str, int]:
    """Reconstructs ``source`` into the file ``output`` or other storage, replacing what is there unless it is resumed.

    Args:
        metrics: the metrics of the run, written next to ``output``.
        sound: what to store beside the frames.

    Returns:
        the largest peak memory in bytes over all frames, by stage; a GPU's under the stage's name and "on the GPU".
    """
    from structgstream.recorder import record
    from structgstream.session.struct_gstream import stream_pipeline

    start = partial(
        record,
        output,
        source,
        stream_pipeline(config),
        backend,
        resume=resume,
        storage=storage,
        metadata=metadata,
        remarks=None if metrics is None else metrics.frame,
        sound=sound,
    )
    return _follow(start, source, output=output, metrics=metrics)


def _follow(
    start: "Callable[..., Run]",
    source: "FrameStream",
    *,
    output: Path,
    metrics: "RunMetrics | None",
    in_qualities: bool = False,
) -> dict[str, int]:
    """Starts a run, given ``on_step``, and shows it until it ends or is stopped; returns the peaks of
    :func:`run_reconstruction`.

    Ctrl-C interrupts a recording at once; live cameras and several qualities end after the frame being fitted.
    """
    from structgstream.data.live.source import LiveSource
    from structgstream.data.source import frame_count

    stop = source.stop if isinstance(source, LiveSource) else lambda: None
    run = start(on_step=lambda step: progress.step(step))  # progress needs the number of existing frames
    done = run.done
    total, peaks, pressed = frame_count(source), dict[str, int](), StopSignal(number=signal.SIGINT)

    def message() -> str:
        if not done and not in_qualities:
            return "No frame was done, so no stream was written; its log and its metrics were begun."
        frames = f"{done}{'' if total is None else f' of {total}'} frames{' in all qualities' if in_qualities else ''}"
        return f"{output} has {frames}; continue with the same command and --resume."

    with (
        interruption(message),
        StopSignal(stop) as ending,
        monitored(source, metrics, done=done) as progress,
        pressed if in_qualities and total is not None else nullcontext(),
        closing(run.reports) as reports,
    ):
        for one in reports:
            report, quality, whole = (one.report, one.quality, one.whole) if in_qualities else (one, None, True)
            on_gpu = {f"{stage} on the GPU": size for stage, size in report.peak_device_bytes.items()}
            for stage, size in {**report.peak_memory_bytes, **on_gpu}.items():
                peaks[stage] = max(size, peaks.get(stage, 0))
            progress.frame(report, quality=quality)
            if whole:
                done = report.index + 1
                ending.end(whole=done == total)
                pressed.end(whole=done == total)
        ending.end(whole=done == total)  # Live cameras had nothing to give any more.
        if not done:
            raise KeyboardInterrupt  # They were stopped before frame 0.
    return peaks


def _print_config(arguments: list[str]) -> None:
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    parser.add_argument("--preset")
    try:
        preset = parser.parse_known_args(arguments)[0].preset
    except argparse.ArgumentError:
        raise UsageError("--preset needs a name after it, such as --preset fast.") from None
    config, name = resolve_config(preset, [], command="reconstruct", seed=None)
    print(f"Each field of the configuration is an option of reconstruct; values are those of the preset {name!r}.\n")
    width = shutil.get_terminal_size().columns if sys.stdout.isatty() else None
    print("\n".join(config_lines(config, width=width)))


def _reconstruct_qualities(options: Reconstruct, config: "StreamConfig", *, preset: str) -> None:
    """Reconstructs in the qualities of the options, with a progress display."""
    if options.quality is not None or options.mbits is not None:
        got = "--quality" if options.mbits is None else "--mbits"
        raise UsageError(
            f"--qualities has a Q for each quality, got {got} besides, which is for one stream; leave {got} out."
        )
    from structgstream.qualities import configured, qualities_in, record_qualities

    with usage_errors():
        qualities = qualities_in(options.qualities or ())
        for quality in qualities:
            configured(config, quality)
    console, names = Console(), [quality.name for quality in qualities]
    opened = open_scene(options, config, preset=preset, console=console)
    storages = options.segments.quality_folders(
        options.output, names, resume=options.resume, overwrite=options.overwrite, clocks=opened.clocks
    )
    metrics = run_metrics(opened.source, options.output, qualities=names)

    start = partial(
        record_qualities,
        options.output,
        opened.source,
        config,
        qualities,
        opened.backend,
        storages=storages,
        resume=options.resume,
        metadata=opened.metadata,
        metrics=metrics,
        sound=opened.sound,
    )
    _follow(start, opened.source, output=options.output, metrics=metrics, in_qualities=True)
    print_lines(console, f"Wrote {options.output}: {', '.join(names)}")
