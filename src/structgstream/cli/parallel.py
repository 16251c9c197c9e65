# SPDX-License-Identifier: Apache-2.0
"""``structgstream parallel``."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro
from rich.console import Console

from structgstream.cli.app import Interrupted, UsageError, usage_errors
from structgstream.cli.options import (
    CaptureOptions,
    Device,
    Flag,
    Folder,
    check_ending,
    open_selected_capture,
    parse_known_options,
    resolve_config,
)
from structgstream.cli.parallel_display import ParallelDisplay
from structgstream.cli.progress import human_bytes, print_lines
from structgstream.executors.opening import ExecutorName, ExecutorOptions

if TYPE_CHECKING:
    from structgstream.executors.executor import TaskQueue
    from structgstream.parallel.driver import Job
    from structgstream.parallel.exchange import ObjectStore
    from structgstream.parallel.parts import Parts
    from structgstream.session.presets import StreamConfig


@dataclass(frozen=True)
class WorkerOptions:
    """Options that say what runs the groups."""

    executor: ExecutorName = "local"
    """local: processes of this machine; inline: this process, one group after the other; ray: a Ray cluster, which
    needs the extra cluster (docs/cluster.md)."""
    workers: Annotated[int | None, tyro.conf.arg(metavar="N", help_behavior_hint="")] = None
    """Groups at a time. Default: one a GPU, or one a core. A cluster that is joined has its own number."""
    threads: Annotated[int | None, tyro.conf.arg(metavar="N", help_behavior_hint="")] = None
    """Threads of each. Default: its share of the cores; one on a cluster."""
    track_threads: Annotated[int | None, tyro.conf.arg(metavar="N", help_behavior_hint="")] = None
    """Threads of the tracking pass, for which all groups wait; fewer groups run meanwhile if these are more than a
    worker's. Default: as a worker."""
    address: Annotated[str | None, tyro.conf.arg(metavar="HOST:PORT", help_behavior_hint="")] = None
    """Head of the Ray cluster to join. Default: a cluster of this machine alone, for this run."""

    @property
    def chosen(self) -> ExecutorOptions:
        """As executors take them.

        Raises:
            UsageError: an address without Ray.
        """
        if self.address is not None and self.executor != "ray":
            raise UsageError("--address is the head of a Ray cluster; add --executor ray.")
        return ExecutorOptions(self.executor, self.workers, self.threads, self.address)


@dataclass(frozen=True)
class Parallel:
    """Turns a recorded capture into a stream, groups of frames side by side.

    Frame 0 is fitted first, then a pass tracks what moves through all frames, and each group of frames is fitted as
    soon as the pass has come to it (docs/cluster.md). The parts are in OUT.parts; after Ctrl-C, a crash or a
    failure the same command continues with those that are not complete. Where a group runs does not change a byte.

    Example: structgstream parallel basketball -o ball.sgs --groups 30 --workers 2

    Example: structgstream parallel basketball -o ball.sgs --executor ray --address head:6379
    """

    scene: tyro.conf.Positional[Folder]
    """The capture; on a cluster all machines see it at the same place."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="OUT.sgs")]
    """The stream file to write; on a cluster all machines see its folder at the same place."""
    groups: Annotated[int | None, tyro.conf.arg(metavar="N", help_behavior_hint="")] = None
    """Frames of a group: a multiple of the key interval. Default: one key interval."""
    split_at_low_motion: Flag = False
    """Move each border between groups to a frame nearby in which few pixels change."""
    allow_unaligned: Flag = False
    """Allow an N that is no multiple of the key interval; each group then costs one more key packet."""
    preset: Annotated[str | None, tyro.conf.arg(metavar="NAME", help_behavior_hint="")] = None
    """compact (default), fine, fast, or tiny; fields of the configuration are options as of reconstruct."""
    quality: Annotated[float | None, tyro.conf.arg(metavar="Q", help_behavior_hint="")] = None
    """0 is the preset's quality, 1 halves every quantization step, -1 doubles it; from -6 to 6."""
    device: Device = "auto"
    """Compute back-end; auto takes the first available of cuda, cpu and reference (plain PyTorch, slow)."""
    seed: Annotated[int | None, tyro.conf.arg(metavar="N", help_behavior_hint="")] = None
    """Random seed. Default: the preset's."""
    overwrite: Flag = False
    """Replace OUT and its parts when they exist."""
    store: Annotated[str | None, tyro.conf.arg(metavar="URL", help_behavior_hint="")] = None
    """Object store of the parts if machines share no folder, such as s3://bucket/runs/ball. Needs the extra cloud."""
    capture: CaptureOptions = field(default_factory=CaptureOptions)
    run: WorkerOptions = field(default_factory=WorkerOptions)


def main(arguments: list[str]) -> None:
    """Runs with a display of all groups."""
    options, rest = parse_known_options(Parallel, "parallel", arguments=arguments)
    check_ending(options.output, ".sgs", command="parallel")
    from structgstream.session.presets import with_budget  # after --help, which needs no torch

    config, preset = resolve_config(options.preset, rest, command="parallel", seed=options.seed)
    with usage_errors():
        config = with_budget(config, name=preset, quality=options.quality, mbits=None)
    chosen = options.run.chosen
    if options.groups is not None and options.groups < 1:
        raise UsageError(f"--groups counts frames, from 1; got {options.groups}.")
    from structgstream.owned_folders import Owner
    from structgstream.parallel.exchange import ObjectStore
    from structgstream.parallel.object_folder import ObjectFolder
    from structgstream.parallel.parts import PURPOSE, Parts

    parts, console = Parts(parts_folder(options.output)), Console()
    # Errors are raised before anything is made or removed.
    _check(options, config, parts)
    with usage_errors():
        executor = open_tasks(chosen, options.device)
    with executor:
        job = _job(options, rest)
        store = None if options.store is None else ObjectStore(ObjectFolder(options.store), parts, cut=job.unit.cut)
        stored = None if store is None else store.check_owner(job.key)
        owner = parts.check() or stored or replace(Owner.new(PURPOSE), key=job.key)
        with parts.locked(owner=owner):
            if store is not None and stored is None:
                store.mark(owner)
            if options.overwrite:
                # If this is killed in between, the folder still has the old plan, which other runs refuse.
                if store is not None:
                    store.clear()
                parts.clear()
            _drive(job, parts, executor, store, console)
    size = human_bytes(options.output.stat().st_size)
    print_lines(console, f"Wrote {options.output}: {size}. Its parts in {parts.folder} are no longer needed.")


def _check(options: Parallel, config: "StreamConfig", parts: "Parts") -> None:
    """Check the options against the capture, and that the output and its parts may be written.

    Raises:
        StructGStreamError: the capture cannot be read, the groups do not fit it, or the output exists.
    """
    from structgstream.groups.boundaries import check_length
    from structgstream.recorder import check_output
    from structgstream.session.struct_gstream import stream_pipeline

    source = open_selected_capture(options.scene, options.capture)
    if options.groups is not None and not options.allow_unaligned:
        check_length(options.groups, key_interval=stream_pipeline(config).codec.key_interval(source.fps))
    parts.check()
    check_output(options.output, may_exist=options.overwrite or bool(parts.completed), resume=False)


def parts_folder(output: Path) -> Path:
    """The folder of the parts of a stream."""
    return output.with_name(f"{output.name}.parts").absolute()


def open_tasks(options: ExecutorOptions, device: Device) -> "TaskQueue":
    """The executor of the options, on this machine's cores and GPUs.

    Raises:
        ConfigError: less than one worker, or a cluster that cannot be joined.
        MissingExtraError: a package is missing.
    """
    from structgstream.evaluation.environment import usable_cores
    from structgstream.executors.opening import open_executor

    return open_executor(options, cores=usable_cores(), gpus=gpus_of(device))


def gpus_of(device: Device) -> int:
    """Number of GPUs of this machine that the tasks use."""
    if device not in ("auto", "cuda"):
        return 0
    import torch

    return torch.cuda.device_count()


def join_arguments(options: WorkerOptions, device: Device) -> tuple[str, ...]:
    """As many processes as the workers have threads; on a cluster and with GPUs the default of ``join``."""
    from structgstream.evaluation.environment import usable_cores
    from structgstream.executors.task import allocate_slots

    if options.executor == "ray" or gpus_of(device):
        return ()
    cores = usable_cores()
    slots = allocate_slots(workers=options.workers, cores=cores, threads=options.threads)
    threads = 1 if options.executor == "inline" else min(cores, sum(slot.threads for slot in slots))
    return ("--workers", str(threads))


def _job(options: Parallel, rest: list[str]) -> "Job":
    from structgstream.parallel.driver import Job
    from structgstream.parallel.unit import Unit

    capture = options.capture
    header = [*_option("preset", options.preset), *_option("quality", options.quality), *_option("seed", options.seed)]
    header += [*_option("start", capture.start or None), *_option("near", capture.near)]
    header += _option("every", None if capture.every == 1 else capture.every)
    header += _option("scale", None if capture.scale == 1.0 else capture.scale)
    header += [] if capture.held_out is None else ["--held-out", *capture.held_out]
    track = [
        *_option("groups", options.groups),
        *(["--split-at-low-motion"] if options.split_at_low_motion else []),
        *(["--allow-unaligned"] if options.allow_unaligned else []),
    ]
    unit = Unit(
        str(options.scene.absolute()),
        capture.frames,
        (*header, *rest),
        tuple(track),
        options.run.track_threads,
        ("--device", options.device),
        join_arguments(options.run, options.device),
    )
    return Job(unit, options.output.absolute(), int(options.device == "cuda" or gpus_of(options.device) > 0))


def _option(name: str, value: object) -> list[str]:
    return [] if value is None else [f"--{name}", str(value)]


def _drive(job: "Job", parts: "Parts", executor: "TaskQueue", exchange: "ObjectStore | None", console: Console) -> None:
    from structgstream.evaluation.run_log import read_log
    from structgstream.parallel.driver import drive

    with ParallelDisplay(console, lambda first, end: len(read_log(parts.segment(first, end)))) as display:
        try:
            drive(job, parts, executor, exchange=exchange, listener=display.show)
        except KeyboardInterrupt:
            raise Interrupted(f"Complete frames are in {parts.folder}; continue with the same command.") from None
