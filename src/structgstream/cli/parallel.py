# SPDX-License-Identifier: Apache-2.0
"""``structgstream parallel`` and ``plan``."""

import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro
from rich.console import Console
from rich.live import Live
from rich.text import Text

from structgstream.cli.app import UsageError, interruption, usage_errors
from structgstream.cli.options import (
    STANDARD_OUTPUT,
    CaptureOptions,
    Device,
    Flag,
    Folder,
    JsonPath,
    Number,
    PresetName,
    StreamOutput,
    as_arguments,
    check_ending,
    open_selected_capture,
    parse_known_options,
    resolve_config,
    shown_as,
    write_json_output,
)
from structgstream.cli.progress import compact_table, human_bytes, literal_cells, print_lines
from structgstream.executors.tasks import ExecutorName, ExecutorOptions

if TYPE_CHECKING:
    from structgstream.data.source import FrameSource
    from structgstream.executors.tasks import TaskQueue
    from structgstream.parallel.cost import Estimate, Measured, Work
    from structgstream.parallel.driver import Job, State, Status
    from structgstream.parallel.exchange import ObjectStore
    from structgstream.parallel.parts import Parts
    from structgstream.session.presets import StreamConfig


@dataclass(frozen=True)
class WorkerOptions:
    """Options that say what runs the groups."""

    executor: ExecutorName = "local"
    """local: processes of this machine; ray: a Ray cluster, which needs the extra cluster (docs/cluster.md)."""
    workers: Number = None
    """Groups at a time. Default: one a GPU, or one a core. A cluster that is joined has its own number."""
    threads: Number = None
    """Threads of each. Default: its share of the cores; one on a cluster that is joined."""
    track_threads: Number = None
    """Threads of the tracking pass, for which all groups wait; fewer groups run meanwhile if these are more than a
    worker's. Default: as a worker."""
    address: Annotated[str | None, shown_as("HOST:PORT")] = None
    """Head of the Ray cluster to join. Default: a cluster of this machine alone, for this run."""

    @property
    def chosen(self) -> ExecutorOptions:
        """As executors take them."""
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
    output: StreamOutput
    """The stream file to write; on a cluster all machines see its folder at the same place."""
    groups: Number = None
    """Frames of a group: a multiple of the key interval. Default: one key interval."""
    split_at_low_motion: Flag = False
    """Move each border between groups to a frame nearby in which few pixels change."""
    allow_unaligned: Flag = False
    """Allow an N that is no multiple of the key interval; each group then costs one more key packet."""
    preset: PresetName = None
    """compact (default), fine, fast, or tiny; fields of the configuration are options as of reconstruct."""
    quality: Annotated[float | None, shown_as("Q")] = None
    """0 is the preset's quality, 1 halves every quantization step, -1 doubles it; from -6 to 6."""
    device: Device = "auto"
    """Compute back-end; auto takes the first available of cuda, cpu and reference (plain PyTorch, slow)."""
    seed: Number = None
    """Random seed. Default: the preset's."""
    overwrite: Flag = False
    """Replace OUT and its parts when they exist."""
    store: Annotated[str | None, shown_as("URL")] = None
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
    from structgstream.parallel.exchange import ObjectFolder, ObjectStore
    from structgstream.parallel.parts import PURPOSE, Parts

    parts, console = Parts(parts_folder(options.output)), Console()
    # Errors are raised before anything is made or removed.
    _check(options, config, parts)
    with usage_errors():
        executor = open_tasks(chosen, options.device)
    with executor:
        job = _job(options, rest)
        store = None if options.store is None else ObjectStore(ObjectFolder(options.store), parts)
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
    """Check the options against the capture, and that the output and its parts may be written."""
    from structgstream.errors import StorageError
    from structgstream.groups.base import check_for_groups
    from structgstream.groups.track_file import check_length
    from structgstream.parallel.driver import JOIN
    from structgstream.parallel.parts import sha256_of
    from structgstream.recorder import check_output
    from structgstream.session.struct_gstream import stream_pipeline

    check_for_groups(config, name="The configuration")
    source = open_selected_capture(options.scene, options.capture)
    if options.groups is not None and not options.allow_unaligned:
        check_length(options.groups, key_interval=stream_pipeline(config).codec.key_interval(source.fps))
    parts.check()
    check_output(options.output, may_exist=options.overwrite or bool(parts.completed), resume=False)
    if options.output.exists() and not options.overwrite:
        joined = parts.completed.get(JOIN)
        if joined is None or sha256_of(options.output) != joined.sha256:
            raise StorageError(
                f"{options.output} is not the stream that was joined from {parts.folder}, so it may be another one; "
                "move it to another place, and give the same command again."
            )


def parts_folder(output: Path) -> Path:
    """The folder of the parts of a stream."""
    return output.with_name(f"{output.name}.parts").absolute()


def open_tasks(options: ExecutorOptions, device: Device) -> "TaskQueue":
    """The executor of the options, on this machine's cores and GPUs."""
    from structgstream.evaluation.environment import usable_cores
    from structgstream.executors.tasks import open_executor

    return open_executor(options, cores=usable_cores(), gpus=gpus_of(device))


def gpus_of(device: Device) -> int:
    """Number of GPUs of this machine that the tasks use."""
    if device not in ("auto", "cuda"):
        return 0
    import torch

    return torch.cuda.device_count()


def join_arguments(options: WorkerOptions, device: Device) -> tuple[str, ...]:
    """The back-end, which on a cluster's driver without a GPU is what that machine has, and as many processes as the
    workers have threads; on a cluster and with GPUs the default of ``join``."""
    from structgstream.evaluation.environment import usable_cores
    from structgstream.executors.tasks import allocate_slots

    gpus = gpus_of(device)
    backend = ("--device", "auto" if options.executor == "ray" and device == "cuda" and not gpus else device)
    if options.executor == "ray" or gpus:
        return backend
    cores = usable_cores()
    slots = allocate_slots(workers=options.workers, cores=cores, threads=options.threads)
    return (*backend, "--workers", str(min(cores, sum(slot.threads for slot in slots))))


CAPTURE_PART = ("start", "near", "every", "scale", "held_out", "roving")
"""Options of a capture that reconstruct and parallel are given, besides its length."""


def _job(options: Parallel, rest: list[str]) -> "Job":
    from structgstream.parallel.driver import Job, Unit

    header = as_arguments(options, "preset", "quality", "seed") + as_arguments(options.capture, *CAPTURE_PART)
    unit = Unit(
        str(options.scene.absolute()),
        options.capture.frames,
        (*header, *rest),
        tuple(as_arguments(options, "groups", "split_at_low_motion", "allow_unaligned")),
        options.run.track_threads,
        ("--device", options.device),
        join_arguments(options.run, options.device),
    )
    return Job(unit, options.output.absolute(), int(options.device == "cuda" or gpus_of(options.device) > 0))


def _drive(job: "Job", parts: "Parts", executor: "TaskQueue", exchange: "ObjectStore | None", console: Console) -> None:
    from structgstream.evaluation.run_log import read_log
    from structgstream.parallel.driver import drive

    with (
        interruption(lambda: f"Complete frames are in {parts.folder}; continue with the same command."),
        ParallelDisplay(console, lambda first, end: len(read_log(parts.segment(first, end)))) as display,
    ):
        drive(job, parts, executor, exchange=exchange, listener=display.show)


STYLES = {
    "waiting for the track": ("·", "dim"),
    "ready": ("○", ""),
    "running": ("◐", "cyan"),
    "done": ("●", "green"),
    "failed": ("✗", "red"),
}
SHOWN_FIRST = ("failed", "running", "ready", "waiting for the track", "done")
OTHERS = ("running", "ready", "waiting for the track", "failed")
ROWS = 6
SHOWN = 8


def cells(states: Sequence["State"], *, width: int) -> Text:
    """A sign per group; of many groups, one for several, which shows the first of their states in
    :data:`SHOWN_FIRST`."""
    share = max(1, -(-len(states) // (width * ROWS)))
    text = Text()
    for place, start in enumerate(range(0, len(states), share), 1):
        several = states[start : start + share]
        text.append(*STYLES[next(name for name in SHOWN_FIRST if name in several)])
        if place % width == 0:
            text.append("\n")
    return text


def counted(status: "Status") -> str:
    """The status as text."""
    if not status.groups:
        return {"header": "frame 0", "track": "tracking begins"}.get(status.stage, status.stage)
    counts = Counter(str(state) for state in status.states)
    frames = sum(end - first for (first, end), state in zip(status.groups, status.states) if state == "done")
    parts = [f"{counts['done']} of {len(status.groups)} groups done ({frames} of {status.groups[-1][1]} frames)"]
    parts += [f"{counts[name]} {name}" for name in OTHERS if counts[name]]
    return ", ".join(["joining", *parts[:1]] if status.stage == "join" else parts)


class ParallelDisplay:
    """Shows the status: all groups, redrawn on a terminal, else lines; ``frames_of`` counts the fitted frames of a
    running group."""

    def __init__(self, console: Console, frames_of: Callable[[int, int], int]) -> None:
        self._console, self._frames_of = console, frames_of
        self._begun = time.monotonic()
        self._live = Live(Text(), console=console, refresh_per_second=2)
        self._printed = ""

    def __enter__(self) -> "ParallelDisplay":
        if self._console.is_terminal:
            self._live.start()
        return self

    def __exit__(self, *raised: object) -> None:
        if self._console.is_terminal:
            self._live.stop()

    def show(self, status: "Status") -> None:
        """Redraws the groups on a terminal; elsewhere prints a line if it has changed."""
        if self._console.is_terminal:
            self._live.update(self._picture(status))
            return
        done = sum(state == "done" for state in status.states)
        line = f"{status.stage}: {done} of {len(status.groups)} groups done" if status.groups else status.stage
        line += f", failed: {', '.join(status.failed)}" if status.failed else ""
        if line != self._printed:
            print_lines(self._console, line)
            self._console.file.flush()
            self._printed = line

    def _picture(self, status: "Status") -> Text:
        width = max(10, min(self._console.width - 2, 100))
        seconds = time.monotonic() - self._begun
        text = Text(f"{counted(status)}, {seconds / 60:.0f} min {seconds % 60:.0f} s\n")
        text.append_text(cells(status.states, width=width))
        running = [group for group, state in zip(status.groups, status.states) if state == "running"]
        for first, end in running[:SHOWN]:
            text.append(f"\n  frames {first}:{end}  {self._frames_of(first, end)} of {end - first}")
        if len(running) > SHOWN:
            text.append(f"\n  and {len(running) - SHOWN} more")
        return text


PROBE_FRAMES = 11
PROBE_GROUP = 6
ASSUMED = (
    "Assumed: later frames are like the measured ones; workers do not slow each other down (shared cores, disks and "
    "memory do); every process starts as fast; the tracking pass takes one worker; joining is as fast as in the "
    "measured run, which more cores would make faster; nothing fails."
)


@dataclass(frozen=True)
class Plan:
    """How long a capture would take on so many workers, how many a wanted finish needs, and how large the stream is.

    Measured first: frame 0 and ten frames in two groups, on one worker of this machine (in FOLDER; the same
    command measures only once); or an existing run of parallel. Everything else follows from a model whose assumptions
    are printed.

    Example: structgstream plan basketball -o probe --machines 1 8 64 --finish-hours 2

    Example: structgstream plan basketball --run ball.sgs.parts --machines 8 --length 108000
    """

    scene: tyro.conf.Positional[Folder]
    """The capture."""
    output: Annotated[Path | None, shown_as("FOLDER", "-o")] = None
    """Folder of the probe."""
    run: Annotated[Path | None, shown_as("OUT.parts")] = None
    """Parts of a finished run to take the measurements from; no probe is made."""
    machines: Annotated[tuple[int, ...], shown_as("N [N ...]")] = (1, 8, 64)
    """Numbers of machines to plan for, each like this one."""
    workers: int = 1
    """Workers that run side by side on each machine; each is taken to be as fast as the measured one alone."""
    finish_hours: Annotated[float | None, shown_as("H")] = None
    """Also print how many workers are needed to finish within H hours."""
    groups: Number = None
    """Frames of a group. Default: one key interval."""
    length: Annotated[int | None, shown_as("FRAMES")] = None
    """Plan for so many frames instead of the capture's."""
    preset: PresetName = None
    """compact (default), fine, fast, or tiny; fields of the configuration are options as of reconstruct."""
    device: Device = "auto"
    """Compute back-end of the probe."""
    json: JsonPath = None
    """Write all numbers to this file; - is standard output."""
    capture: CaptureOptions = field(default_factory=CaptureOptions)


def plan(arguments: list[str]) -> None:
    """Measures, computes, prints."""
    options, rest = parse_known_options(Plan, "plan", arguments=arguments)
    if (options.run is None) == (options.output is None):
        raise UsageError("give either -o FOLDER for a probe, or --run OUT.parts of an existing run.")
    check_ending(options.json, ".json", command="plan", option="--json")
    config, _ = resolve_config(options.preset, rest, command="plan", seed=None)
    from structgstream.parallel.cost import Work, measured_in

    source = open_selected_capture(options.scene, options.capture)
    interval = config.key_interval(source.fps)
    with usage_errors():
        work = Work(options.length or len(source), options.groups or interval, interval)
        if options.workers < 1 or min(options.machines, default=0) < 1:
            raise UsageError("--machines and --workers count from 1.")
    if options.run is None and str(options.json) == STANDARD_OUTPUT:
        raise UsageError("--json - needs --run: a probe prints to standard output what it does.")
    console = Console(stderr=str(options.json) == STANDARD_OUTPUT)
    folder = options.run if options.run is not None else _probe(options, rest, console)
    _report(options, work, source, measured_in(folder), console)


def _probe(options: Plan, rest: list[str], console: Console) -> Path:
    """Two groups on one worker, unless they are there."""
    from structgstream.cli.app import main as command

    assert options.output is not None
    stream = options.output / "probe.sgs"
    probe = ["parallel", str(options.scene), "-o", str(stream), "--frames", str(PROBE_FRAMES)]
    probe += ["--groups", str(PROBE_GROUP), "--allow-unaligned", "--workers", "1"]
    probe += as_arguments(options, "device", "preset") + as_arguments(options.capture, *CAPTURE_PART)
    console.print(f"Probe: frame 0 and {PROBE_FRAMES - 1} frames, on one worker.", highlight=False)
    if status := command([*probe, *rest]):
        raise SystemExit(status)  # It has said why.
    return parts_folder(stream)


def _report(options: Plan, work: "Work", source: "FrameSource", found: "Measured", console: Console) -> None:
    from structgstream.parallel.cost import estimate, sequential_seconds, serial_seconds, stream_bytes, workers_for

    costs = found.costs
    estimates = [(count, estimate(costs, work, count * options.workers)) for count in options.machines]
    alone, serial, size = sequential_seconds(costs, work), serial_seconds(costs, work), stream_bytes(costs, work)
    seconds = work.frames / source.fps
    print_lines(
        console,
        f"{source.name}: {work.frames} frames ({seconds:.1f} s of film) in {len(work.groups)} groups of {work.group}.",
        f"Measured on one worker: frame 0 {costs.header_seconds:.1f} s, tracking {costs.track_seconds:.2f} s a frame, "
        f"a group {costs.process_seconds + costs.first_seconds:.1f} s and {costs.frame_seconds:.2f} s a frame "
        f"({found.groups} groups), memory {human_bytes(costs.worker_bytes)}.",
        f"One frame after the other: {_time(alone)}. Stream: {human_bytes(size)}, {size * 8e-6 / seconds:.2f} Mbit/s.",
    )
    _table(console, estimates)
    print_lines(console, _serial(costs.header_seconds, serial, alone, work.frames))
    wanted, rate = None, 1 / costs.frame_seconds
    if options.finish_hours is not None:
        wanted = workers_for(costs, work, options.finish_hours * 3600)
        least = _time(estimate(costs, work, len(work.groups) + 1).seconds)
        ends = f"{wanted.workers} workers ({_time(wanted.seconds)})" if wanted else f"not possible; least {least}"
        print_lines(console, f"Within {options.finish_hours:g} h: {ends}.")
    print_lines(console, _live(rate, source.fps), ASSUMED)
    if options.json is not None:
        facts: dict[str, Any] = {"work": asdict(work), "measured": asdict(found), "bytes": size, "live_fps": rate}
        facts |= {"sequential_seconds": alone, "serial_seconds": serial}
        facts["estimates"] = [{"machines": count, **asdict(each)} for count, each in estimates]
        facts["wanted"] = None if wanted is None else asdict(wanted)
        write_json_output(options.json, facts)


def _live(rate: float, fps: float) -> str:
    if rate >= fps:
        return f"Live: {rate:.1f} frames a second here, enough for {fps:g}."
    return (
        f"Live, where each frame needs the one before, workers do not help: {rate:.2f} frames a second here, "
        f"{fps / rate:.1f} times too slow for {fps:g}."
    )


def _serial(header: float, serial: float, alone: float, frames: int) -> str:
    growing = serial - header
    return (
        f"Serial whatever the workers: {_time(serial)}, of which frame 0 {_time(header)} once, and tracking and "
        f"joining {_time(growing)}, which grow with the film ({_time(1000 * growing / frames)} for 1000 frames); so "
        f"never more than {alone / serial:.1f} times faster."
    )


def _table(console: Console, estimates: list[tuple[int, "Estimate"]]) -> None:
    table = compact_table("machines", "workers", "time", "after tracking", "times faster", "efficiency")
    for count, each in estimates:
        cells = (str(count), str(each.workers), _time(each.seconds), _time(each.tail_seconds))
        table.add_row(*literal_cells(*cells, f"{each.speedup:.2f}", f"{100 * each.efficiency:.0f} %"))
    console.print(table)


def _time(seconds: float) -> str:
    if seconds < 120:
        return f"{seconds:.1f} s"
    return f"{seconds / 60:.1f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"
