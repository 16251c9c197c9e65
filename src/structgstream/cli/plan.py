# SPDX-License-Identifier: Apache-2.0
"""``structgstream plan``."""

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro
from rich.console import Console

from structgstream.cli.app import UsageError, usage_errors
from structgstream.cli.options import (
    STANDARD_OUTPUT,
    CaptureOptions,
    Device,
    Folder,
    JsonPath,
    check_ending,
    open_selected_capture,
    parse_known_options,
    resolve_config,
    write_json_output,
)
from structgstream.cli.progress import human_bytes, print_lines
from structgstream.cli.tables import compact_table, literal_cells

if TYPE_CHECKING:
    from structgstream.data.source import FrameSource
    from structgstream.parallel.cost import Estimate, Measured, Work

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

    Example: structgstream plan basketball --run ball.sgs.parts --machines 8 --frames 108000
    """

    scene: tyro.conf.Positional[Folder]
    """The capture."""
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"], metavar="FOLDER", help_behavior_hint="")] = None
    """Folder of the probe."""
    run: Annotated[Path | None, tyro.conf.arg(metavar="OUT.parts", help_behavior_hint="")] = None
    """Parts of a finished run to take the measurements from; no probe is made."""
    machines: Annotated[tuple[int, ...], tyro.conf.arg(metavar="N [N ...]", help_behavior_hint="")] = (1, 8, 64)
    """Numbers of machines to plan for, each like this one."""
    workers: int = 1
    """Workers that run side by side on each machine; each is taken to be as fast as the measured one alone."""
    finish_hours: Annotated[float | None, tyro.conf.arg(metavar="H", help_behavior_hint="")] = None
    """Say how many workers end within H hours."""
    groups: Annotated[int | None, tyro.conf.arg(metavar="N", help_behavior_hint="")] = None
    """Frames of a group. Default: one key interval."""
    length: Annotated[int | None, tyro.conf.arg(metavar="FRAMES", help_behavior_hint="")] = None
    """Plan for so many frames instead of the capture's."""
    preset: Annotated[str | None, tyro.conf.arg(metavar="NAME", help_behavior_hint="")] = None
    """compact (default), fine, fast, or tiny; fields of the configuration are options as of reconstruct."""
    device: Device = "auto"
    """Compute back-end of the probe."""
    json: JsonPath = None
    """Write all numbers to this file; - is standard output."""
    capture: CaptureOptions = field(default_factory=CaptureOptions)


def main(arguments: list[str]) -> None:
    """Measures, computes, prints."""
    options, rest = parse_known_options(Plan, "plan", arguments=arguments)
    if (options.run is None) == (options.output is None):
        raise UsageError("give either -o FOLDER for a probe, or --run OUT.parts of an existing run.")
    check_ending(options.json, ".json", command="plan", option="--json")
    config, _ = resolve_config(options.preset, rest, command="plan", seed=None)
    from structgstream.parallel.cost import Work, measured_in

    source = open_selected_capture(options.scene, options.capture)
    interval = max(1, round(config.key_interval_seconds * source.fps))
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
    options.output.mkdir(parents=True, exist_ok=True)
    stream = options.output / "probe.sgs"
    capture = options.capture
    probe = ["parallel", str(options.scene), "-o", str(stream), "--frames", str(PROBE_FRAMES)]
    probe += ["--groups", str(PROBE_GROUP), "--allow-unaligned", "--workers", "1", "--device", options.device]
    probe += [] if options.preset is None else ["--preset", options.preset]
    probe += [] if capture.held_out is None else ["--held-out", *capture.held_out]
    probe += ["--scale", str(capture.scale), "--start", str(capture.start), "--every", str(capture.every)]
    probe += [] if capture.near is None else ["--near", str(capture.near)]
    console.print(f"Probe: frame 0 and {PROBE_FRAMES - 1} frames, on one worker.", highlight=False)
    if status := command([*probe, *rest]):
        raise SystemExit(status)  # It has said why.
    from structgstream.cli.parallel import parts_folder

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
    wanted = None
    if options.finish_hours is not None:
        wanted = workers_for(costs, work, options.finish_hours * 3600)
        least = _time(estimate(costs, work, len(work.groups) + 1).seconds)
        ends = f"{wanted.workers} workers ({_time(wanted.seconds)})" if wanted else f"not possible; least {least}"
        print_lines(console, f"Within {options.finish_hours:g} h: {ends}.")
    rate = 1 / costs.frame_seconds
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
    table = compact_table()
    for head in ("machines", "workers", "time", "after tracking", "times faster", "efficiency"):
        table.add_column(head, justify="right")
    for count, each in estimates:
        cells = (str(count), str(each.workers), _time(each.seconds), _time(each.tail_seconds))
        table.add_row(*literal_cells(*cells, f"{each.speedup:.2f}", f"{100 * each.efficiency:.0f} %"))
    console.print(table)


def _time(seconds: float) -> str:
    if seconds < 120:
        return f"{seconds:.1f} s"
    return f"{seconds / 60:.1f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"
