# SPDX-License-Identifier: Apache-2.0
"""``structgstream reconstruct``."""

import math
import os
from collections.abc import Mapping
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro
from rich.console import Console

from structgstream.cli.app import Interrupted, UsageError
from structgstream.cli.options import (
    CaptureOptions,
    Device,
    Folder,
    opened_capture,
    parsed_with_rest,
    resolved_config,
)
from structgstream.cli.progress import display, human_bytes
from structgstream.errors import StorageError, StructGStreamError

if TYPE_CHECKING:
    from structgstream.data.source import FrameSource
    from structgstream.kernels.backend import Backend
    from structgstream.presets import StreamConfig

MOST_QUALITY = 6.0  # steps 64 times as small, or as large


@dataclass(frozen=True)
class Reconstruct:
    """Turns a capture into a stream, one frame after the other.

    The file can be read while it grows: structgstream play OUT.sgs --wait shows each frame as it comes. Ctrl-C keeps
    the frames that are done; --resume goes on after them. Seconds by stage and memory of each frame go to
    OUT.log.jsonl. Any field of the configuration is an option by its path: --online.iterations 50 (see --help-config).

    Example: structgstream reconstruct basketball -o ball.sgs --frames 20 --held-out 0 10 15 30

    Example: structgstream reconstruct basketball -o ball.sgs --preset fast --scale 0.5 --online.iterations 40

    Example: structgstream reconstruct basketball -o ball.sgs --mbits 5
    """

    scene: tyro.conf.Positional[Folder]
    """The capture: a folder of one of the known layouts."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="OUT.sgs")]
    """The stream file to write."""
    preset: Annotated[str | None, tyro.conf.arg(metavar="NAME", help_behavior_hint="")] = None
    """compact (default: small packets), rig (the paper on any rig), motion (rig, fits only what moves), fast (a try in
    minutes), paper-n3dv, paper-meetroom, paper-immersive, tiny (tests)."""
    quality: Annotated[float | None, tyro.conf.arg(metavar="Q", help_behavior_hint="")] = None
    """Of compact streams: 0 is the preset's own quality, 1 makes every step half as large, -1 twice as large."""
    mbits: Annotated[float | None, tyro.conf.arg(metavar="R", help_behavior_hint="")] = None
    """Of compact streams: keep to R Mbit/s over every second, the header left aside. Default: constant quality,
    whatever it costs."""
    device: Device = "auto"
    """What computes; auto takes the first of cuda, cpu, reference that is there."""
    seed: Annotated[int | None, tyro.conf.arg(metavar="N", help_behavior_hint="")] = None
    """Seed of everything random. Default: the preset's."""
    resume: bool = False
    """Go on after the last whole frame of OUT.sgs. The same options give the same file as an uninterrupted run."""
    overwrite: bool = False
    """Replace OUT.sgs when it exists."""
    help_config: bool = False
    """List the fields of the configuration with the preset's values."""
    capture: CaptureOptions = field(default_factory=CaptureOptions)


def main(arguments: list[str]) -> None:
    """Reconstructs with a progress display."""
    if "--help-config" in arguments:
        _print_config(arguments)
    options, rest = parsed_with_rest(Reconstruct, "reconstruct", arguments=arguments)
    if options.resume and options.overwrite:
        raise UsageError("--resume keeps the file and --overwrite replaces it: choose one.")
    config, preset = resolved_config(options.preset, rest, command="reconstruct", seed=options.seed)
    config = with_budget(config, preset=preset, quality=options.quality, mbits=options.mbits)
    check_output(options.output, may_exist=options.resume or options.overwrite)
    from structgstream.kernels.backend import select_backend
    from structgstream.presets import departures

    source = opened_capture(options.scene, options.capture)
    backend = select_backend(options.device)
    console = Console()
    console.print(
        f"{source.name}: {len(source.rig.training)} training cameras, held out: "
        f"{', '.join(source.rig.testing) or 'none'}; {len(source)} frames; preset {preset}, back-end {backend.name}.",
        highlight=False,
        markup=False,
        soft_wrap=True,
    )
    if differences := departures(preset, source.rig):
        console.print(f"The paper's data of {preset} are others: {'; '.join(differences)}.", highlight=False)
    peaks = reconstructed(
        source,
        config,
        output=options.output,
        backend=backend,
        metadata={"preset": preset, "start": options.capture.start, "scale": options.capture.scale},
        resume=options.resume,
    )
    if peaks:
        stages = ", ".join(f"{stage} {human_bytes(size)}" for stage, size in peaks.items())
        console.print(f"Peak memory by stage: {stages}.", highlight=False, markup=False, soft_wrap=True)
    console.print(f"Wrote {options.output}", highlight=False, markup=False, soft_wrap=True)


def reconstructed(
    source: "FrameSource",
    config: "StreamConfig",
    *,
    output: Path,
    backend: "Backend",
    metadata: Mapping[str, object],
    resume: bool = False,
) -> dict[str, int]:
    """Reconstructs ``source`` into the file ``output``, replacing what is there unless it is resumed.

    Returns:
        the largest peak of memory in bytes over all frames, by stage; a GPU's under the stage's name and "on the GPU".

    Raises:
        Interrupted: the user pressed Ctrl-C; whole frames are in the file.
        StructGStreamError: whatever goes wrong; whole frames are in the file.
    """
    from structgstream.codec.sinks import FileSink
    from structgstream.data.prefetch import Prefetch
    from structgstream.evaluation.run_log import append_log, begin_log, log_entry
    from structgstream.session import Session

    sink, resumed = FileSink.resume(output) if resume else (FileSink(output, overwrite=True), None)
    done = 0 if resumed is None else len(resumed)
    peaks: dict[str, int] = {}
    try:
        with display(len(source), done=done) as progress:
            try:
                session = Session(
                    Prefetch(source),
                    sink,
                    config,
                    backend,
                    resumed=resumed,
                    metadata=metadata,
                    on_step=progress.step,
                )
                begin_log(output, frames=done)
            except StructGStreamError:
                sink.close()  # resuming took the index off the file
                raise
            with closing(session.run()) as reports:  # pyright: ignore[reportArgumentType] -- a generator
                for report in reports:
                    append_log(output, log_entry(report))
                    on_gpu = {f"{stage} on the GPU": size for stage, size in report.peak_device_bytes.items()}
                    for stage, size in {**report.peak_memory_bytes, **on_gpu}.items():
                        peaks[stage] = max(size, peaks.get(stage, 0))
                    progress.frame(report)
                    done = report.index + 1
    except KeyboardInterrupt:
        kept = f"{output} has {done} of {len(source)} frames; go on with the same command and --resume."
        raise Interrupted(kept if done else "No frame was done, so nothing was written.") from None
    return peaks


def with_budget(config: "StreamConfig", *, preset: str, quality: float | None, mbits: float | None) -> "StreamConfig":
    """``config`` with the options ``--quality`` and ``--mbits``, which are short for fields of it.

    Raises:
        UsageError: the stream's codec has neither, or the value is out of range.
    """
    if quality is None and mbits is None:
        return config
    if config.codec != "compact":
        option = "--mbits" if quality is None else "--quality"
        raise UsageError(
            f"{option} is for streams with the codec compact; the preset {preset!r} makes one with the codec "
            f"{config.codec}. Add --preset compact."
        )
    if quality is not None:
        if not abs(quality) <= MOST_QUALITY:
            raise UsageError(
                f"--quality {quality:g} is not one of {-MOST_QUALITY:g} to {MOST_QUALITY:g}: 0 is the preset's own, "
                "and 1 more makes every step half as large."
            )
        rounding = replace(config.online.rounding, quality=quality)
        config = replace(config, online=replace(config.online, rounding=rounding))
    if mbits is not None:
        if not 0 < mbits < math.inf:
            raise UsageError(f"--mbits {mbits:g} is no rate; it is in megabits a second, such as --mbits 5.")
        config = replace(config, rate=replace(config.rate, target_mbits=mbits))
    return config


def check_output(output: Path, *, may_exist: bool) -> None:
    """Whether the stream can be written is found out before the first frame takes its minutes.

    Raises:
        StorageError: the file exists, its folder cannot be made, or nothing may be written there.
    """
    if output.is_dir():
        raise StorageError(f"{output} is a folder; give the name of a file, such as {output / 'scene.sgs'}.")
    if output.exists() and not may_exist:
        raise StorageError(
            f"{output} exists; continue it with --resume, replace it with --overwrite, or choose another name."
        )
    try:
        output.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StorageError(f"The folder {output.parent} cannot be made ({error.strerror}).") from None
    if not os.access(output if output.exists() else output.parent, os.W_OK):
        raise StorageError(f"{output} cannot be written (no permission).")


def _print_config(arguments: list[str]) -> None:
    given = arguments.index("--preset") + 1 if "--preset" in arguments else len(arguments)
    preset = arguments[given] if given < len(arguments) else None
    resolved_config(preset, ["--help"], command="reconstruct SCENE -o OUT.sgs", seed=None)
