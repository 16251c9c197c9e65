# SPDX-License-Identifier: Apache-2.0
"""``structgstream reconstruct``, also into several qualities."""

import shutil
import sys
from collections.abc import Mapping, Sequence
from contextlib import closing, nullcontext
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro
from rich.console import Console

from structgstream.cli.app import Interrupted, UsageError, usage_errors
from structgstream.cli.live_run import LiveChoice, monitored, open_live, run_metrics, stop_of, stop_on_interrupt
from structgstream.cli.options import (
    CaptureOptions,
    Device,
    Flag,
    Folder,
    check_ending,
    config_lines,
    open_selected_capture,
    parse_known_options,
    resolve_config,
)
from structgstream.cli.progress import human_bytes, print_lines
from structgstream.cli.segment_options import SegmentOptions
from structgstream.cli.signals import Terminated, Termination

if TYPE_CHECKING:
    from structgstream.cli.segment_options import Captured, SegmentsStorage
    from structgstream.data.source import FrameStream
    from structgstream.kernels.backend import Backend
    from structgstream.qualities.ladder import Quality
    from structgstream.recorder import Storage
    from structgstream.run_metrics import RunMetrics
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
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="OUT.sgs")]
    """The stream file to write; with --sink segments, a folder."""
    preset: Annotated[str | None, tyro.conf.arg(metavar="NAME", help_behavior_hint="")] = None
    """compact (default: small packets), fine (compact with twice the iterations), fast (compact in minutes), rig (the
    paper on any rig), motion (as rig, trains only what moves), paper-n3dv, paper-meetroom, paper-immersive, tiny (for
    tests)."""
    quality: Annotated[float | None, tyro.conf.arg(metavar="Q", help_behavior_hint="")] = None
    """Compact streams only: 0 is the preset's quality, 1 halves every quantization step, -1 doubles it; from -6 to
    6."""
    mbits: Annotated[float | None, tyro.conf.arg(metavar="R", help_behavior_hint="")] = None
    """Compact streams only: target rate in Mbit/s over every second, without the header. Default: constant quality."""
    qualities: Annotated[
        tuple[str, ...] | None, tyro.conf.arg(metavar="NAME=Q NAME=Q [NAME=Q ...]", help_behavior_hint="")
    ] = None
    """Several qualities of the same frames, each a folder OUT/NAME of segments with --quality Q, and a list from which
    players choose (docs/live.md). With --sink segments."""
    device: Device = "auto"
    """Compute back-end; auto takes the first available of cuda, cpu and reference (plain PyTorch, slow)."""
    seed: Annotated[int | None, tyro.conf.arg(metavar="N", help_behavior_hint="")] = None
    """Random seed. Default: the preset's."""
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
    if any(argument == "--init" or argument.startswith("--init=") for argument in arguments):
        raise UsageError("reconstruct has no --init: a group of frames is fitted by structgstream fit-group.")
    if "--help-config" in arguments:
        _print_config(arguments)
        return
    options, rest = parse_known_options(Reconstruct, "reconstruct", arguments=arguments)
    check_ending(options.output, ".sgs", command="reconstruct", folder=True)
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
    with options.segments.storage(options.output, may_exist=may_exist, report=partial(print_lines, console)) as storage:
        _reconstruct(options, config, opened, storage=storage, console=console)
    print_lines(console, f"Wrote {options.output}")


def _reconstruct(
    options: Reconstruct,
    config: "StreamConfig",
    opened: "OpenedScene",
    *,
    storage: "SegmentsStorage | None",
    console: Console,
) -> None:
    peaks = run_reconstruction(
        opened.source,
        config,
        output=options.output,
        backend=opened.backend,
        metadata=opened.metadata,
        resume=options.resume,
        storage=None if storage is None else storage(opened.captured),
        metrics=run_metrics(opened.source, options.output),
    )
    if peaks:
        stages = ", ".join(f"{stage} {human_bytes(size)}" for stage, size in peaks.items())
        print_lines(console, f"Peak memory by stage: {stages}.")


@dataclass(frozen=True)
class OpenedScene:
    """What a run reads, and with what it computes."""

    source: "FrameStream"  # a recording, or live cameras
    captured: "Captured | None"  # when a frame was filmed, Unix time, by its number; None for a recording
    backend: "Backend"
    metadata: Mapping[str, object]  # of the run, for headers


def open_scene(options: Reconstruct, config: "StreamConfig", *, preset: str, console: Console) -> OpenedScene:
    """The capture, or the live cameras, that the options name; says what it is.

    Raises:
        UsageError: options that contradict each other.
        StructGStreamError: it cannot be read, or the back-end is not available.
    """
    from structgstream.evaluation.recording import part_metadata
    from structgstream.kernels.backend import select_backend
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
        )
        length, captured = "live", source.captured
    else:
        options.live.check(options.scene)
        source = open_selected_capture(options.scene, options.capture)
        length, captured = f"{len(source)} frames", None
    backend = select_backend(options.device)
    print_lines(
        console,
        f"{source.name}: {len(source.rig.training)} training cameras, held out: "
        f"{', '.join(source.rig.testing) or 'none'}; {length}; preset {preset}, back-end {backend.name}.",
    )
    if differences := departures(preset, source.rig):
        console.print(f"The paper's data of {preset} are others: {'; '.join(differences)}.", highlight=False)
    blind = unrecognized_faults(len(source.rig.training)) if config.online.motion.enabled else None
    if blind is not None:
        console.print(blind, highlight=False)
    part = part_metadata(start=options.capture.start, scale=options.capture.scale, every=options.capture.every)
    metadata = {"preset": preset, **part}
    return OpenedScene(source, captured, backend, metadata)


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
) -> dict[str, int]:
    """Reconstructs ``source`` into the file ``output`` or other storage, replacing what is there unless it is resumed.

    Args:
        source: the capture, or live cameras, which need ``metrics``.
        resume: continue after the last whole frame.
        metrics: the metrics of the run, written next to ``output``.

    Returns:
        the largest peak memory in bytes over all frames, by stage; a GPU's under the stage's name and "on the GPU".

    Raises:
        Interrupted: the user pressed Ctrl-C; whole frames stay in the file.
        Terminated: SIGTERM came; the frame that was being fitted is in the file, too.
        StructGStreamError: any other error; whole frames stay in the file.
    """
    from structgstream.data.source import frame_count
    from structgstream.recorder import record
    from structgstream.session.struct_gstream import stream_pipeline

    total = frame_count(source)
    run = record(
        output,
        source,
        stream_pipeline(config),
        backend,
        resume=resume,
        storage=storage,
        metadata=metadata,
        on_step=lambda step: progress.step(step),  # Created below, because it needs the number of existing frames.
        remarks=None if metrics is None else metrics.frame,
    )
    done = run.done
    peaks: dict[str, int] = {}
    try:
        with (
            Termination(on_ask=stop_of(source)) as ending,
            monitored(source, metrics, done=done) as progress,
            closing(run.reports) as reports,
        ):
            for report in reports:
                on_gpu = {f"{stage} on the GPU": size for stage, size in report.peak_device_bytes.items()}
                for stage, size in {**report.peak_memory_bytes, **on_gpu}.items():
                    peaks[stage] = max(size, peaks.get(stage, 0))
                progress.frame(report)
                done = report.index + 1
                if ending.asked and done != total:
                    raise Terminated
            if ending.asked and done != total:  # Live cameras had nothing to give any more.
                raise Terminated
    except KeyboardInterrupt as error:
        of = "" if total is None else f" of {total}"
        message = f"{output} has {done}{of} frames; continue with the same command and --resume."
        nothing = "No frame was done, so no stream was written; its log and its metrics were begun."
        ended = Terminated if isinstance(error, Terminated) else Interrupted
        raise ended(message if done else nothing) from None
    return peaks


def _print_config(arguments: list[str]) -> None:
    preset = None
    for argument, following in zip(arguments, [*arguments[1:], None], strict=True):
        if argument == "--preset":
            if following is None:
                raise UsageError("--preset needs a name after it, such as --preset fast.")
            preset = following
        elif argument.startswith("--preset="):
            preset = argument.removeprefix("--preset=")
    config, name = resolve_config(preset, [], command="reconstruct", seed=None)
    print(f"Each field of the configuration is an option of reconstruct; values are those of the preset {name!r}.\n")
    width = shutil.get_terminal_size().columns if sys.stdout.isatty() else None
    print("\n".join(config_lines(config, width=width)))


class _Asked:
    """Whether Ctrl-C was pressed while a recording is reconstructed."""

    def __init__(self) -> None:
        self.stopped = False

    def stop(self) -> None:
        """Notes it."""
        self.stopped = True


def _reconstruct_qualities(options: Reconstruct, config: "StreamConfig", *, preset: str) -> None:
    """Reconstructs in the qualities of the options, with a progress display.

    Raises:
        UsageError: options that several qualities do not have, or that contradict each other.
        Interrupted: Ctrl-C; all qualities have the frame that was being fitted, unless it was pressed twice.
        Terminated: SIGTERM; as after Ctrl-C.
        StructGStreamError: any other error; whole frames stay.
    """
    if options.quality is not None or options.mbits is not None:
        got = "--quality" if options.mbits is None else "--mbits"
        raise UsageError(
            f"--qualities has a Q for each quality, got {got} besides, which is for one stream; leave {got} out."
        )
    from structgstream.qualities.ladder import configured, qualities_in

    with usage_errors():
        qualities = qualities_in(options.qualities or ())
        for quality in qualities:
            configured(config, quality)
    console, names = Console(), [quality.name for quality in qualities]
    opened = open_scene(options, config, preset=preset, console=console)
    folders = options.segments.quality_folders(
        options.output, names, resume=options.resume, overwrite=options.overwrite
    )
    storages = {name: storage(opened.captured) for name, storage in folders.items()}
    _run_qualities(options, config, qualities, opened=opened, storages=storages)
    print_lines(console, f"Wrote {options.output}: {', '.join(names)}")


def _run_qualities(
    options: Reconstruct,
    config: "StreamConfig",
    qualities: "Sequence[Quality]",
    *,
    opened: OpenedScene,
    storages: "Mapping[str, Storage[Scene]]",
) -> None:
    from structgstream.data.source import frame_count
    from structgstream.qualities.recording import record_qualities

    source, output = opened.source, options.output
    total, metrics = frame_count(source), run_metrics(source, output, qualities=[one.name for one in qualities])
    run = record_qualities(
        output,
        source,
        config,
        qualities,
        opened.backend,
        storages=storages,
        resume=options.resume,
        metadata=opened.metadata,
        on_step=lambda step: progress.step(step),  # Created below, because it needs the number of existing frames.
        metrics=metrics,
    )
    done, pressed = run.done, _Asked()
    try:
        with (
            Termination(on_ask=stop_of(source)) as ending,
            monitored(source, metrics, done=done) as progress,
            nullcontext() if total is None else stop_on_interrupt(pressed),  # Live cameras are stopped by themselves.
            closing(run.reports) as reports,
        ):
            for one in reports:
                progress.frame(one.report, quality=one.quality)
                done = one.report.index + 1 if one.whole else done
                if one.whole and (ending.asked or pressed.stopped):
                    break
        if done != total and (ending.asked or pressed.stopped):
            raise Terminated if ending.asked else KeyboardInterrupt
    except KeyboardInterrupt as error:
        of = "" if total is None else f" of {total}"
        message = f"{output} has {done}{of} frames in all qualities; continue with the same command and --resume."
        raise (Terminated if isinstance(error, Terminated) else Interrupted)(message) from None
