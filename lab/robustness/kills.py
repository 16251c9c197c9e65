# SPDX-License-Identifier: Apache-2.0
"""Writers of streams that are killed, run out of disk, or lose their object store, at random moments.

    python -m lab.robustness.kills
    python -m lab.robustness.kills --kills 20 --real 2 --full 5 --outages 3 --outage-seconds 2    (a trial)

A writer is a process of its own; it is killed by SIGKILL after a random time, and another goes on after it, until the
stream is whole. After each kill a reader that knows nothing of it must find every frame that the writer had reported
as written, with the right hash; at the end the stream must have the bytes of one that was never interrupted. The
trainer fits the bundled clip with the preset tiny; all others send its packets, again and again, with other numbers.
Moments are drawn with a seed; where in a write they fall is not.
"""

import argparse
import json
import os
import random
import shutil
import signal
import statistics
import tempfile
import threading
import time
import traceback
from dataclasses import asdict
from pathlib import Path

from lab.robustness.stream_outages import full_disks, outages
from lab.robustness.stream_writers import (
    Row,
    Sent,
    Writer,
    content,
    edge_of,
    file_writer,
    readable,
    real_writer,
    repeated,
    segments_writer,
)
from structgstream.codec.reader import open_stream

FRAMES = 60
SINKS = ("segments", "file", "segments of 8 periods", "file of 8 periods")
DISKS = ("seen", "not seen")


def started(writer: Writer, path: Path) -> tuple[int, int]:
    """A process of its own that writes; returns its id and where it reports frames, a byte each."""
    reading, writing = os.pipe()
    child = os.fork()
    if child:
        os.close(writing)
        return child, reading
    os.close(reading)
    status = 1
    try:
        writer(path, lambda frame: os.write(writing, bytes([frame])))
        status = 0
    except Exception:
        traceback.print_exc()
    finally:
        os._exit(status)


def watched(reading: int, into: list[tuple[float, int]]) -> threading.Thread:
    """A thread that notes reported frames and when."""

    def read() -> None:
        while data := os.read(reading, 1):
            into.append((time.monotonic(), data[0]))
        os.close(reading)

    thread = threading.Thread(target=read)
    thread.start()
    return thread


def attempt(writer: Writer, path: Path, *, kill_after: float | None) -> tuple[bool, list[tuple[float, int]]]:
    """One process; returns whether it came to its end, and the frames that it reported, with their times.

    Raises:
        SystemExit: it failed.
    """
    child, reading = started(writer, path)
    seen: list[tuple[float, int]] = []
    thread = watched(reading, seen)
    killer = None if kill_after is None else threading.Timer(kill_after, os.kill, (child, signal.SIGKILL))
    if killer is not None:
        killer.start()
    _, status = os.waitpid(child, 0)
    if killer is not None:
        killer.cancel()
    thread.join()
    if not os.WIFSIGNALED(status) and os.WEXITSTATUS(status):
        raise SystemExit(f"A writer failed with status {os.WEXITSTATUS(status)}.")
    return not os.WIFSIGNALED(status), seen


def killed_streams(row: Row, writer: Writer, *, kills: int, whole: bytes, folder: Path, seed: int, limit: float) -> Row:
    """Streams whose writers are killed after at most ``limit`` seconds each, until there were enough kills."""
    rng = random.Random(seed)
    while row.events < kills:
        path = folder / "killed"
        reported, done = -1, False
        while not done:
            begun = time.monotonic()
            done, seen = attempt(writer, path, kill_after=rng.uniform(0.0, limit) if row.events < kills else None)
            row.events += not done
            if reported >= 0 and seen:
                row.seconds_until_normal.append(seen[0][0] - begun)
            reported = max([reported, *(frame for _, frame in seen)])
            row.reported_frames_lost += max(reported - edge_of(path), 0)
            row.reads_refused += reported >= 0 and not readable(path, whole)
        row.streams += 1
        row.equal += content(path) == whole
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    return row


def table(rows: list[Row]) -> str:
    """The rows as Markdown."""
    heads = ("what", "events", "streams", "equal bytes", "reported frames lost", "reads refused", "s until normal")
    lines = [f"| {' | '.join(heads)}: median, most |", "|---" * len(heads) + "|"]
    for row in rows:
        times = row.seconds_until_normal
        normal = f"{statistics.median(times):.2f}, {max(times):.2f}" if times else "-"
        cells = (row.what, row.events, row.streams, row.equal, row.reported_frames_lost, row.reads_refused, normal)
        lines.append(f"| {' | '.join(map(str, cells))} |")
    return "\n".join(lines)


def parsed() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=200, help="of writers of prepared packets, for each sink")
    parser.add_argument("--of", nargs="+", choices=SINKS, default=SINKS, metavar="SINK", help=", ".join(SINKS))
    parser.add_argument("--real", type=int, default=20, help="kills of trainers")
    parser.add_argument("--real-frames", type=int, default=8)
    parser.add_argument("--full", type=int, default=50, help="disks that fill up, for each kind of disk")
    parser.add_argument("--disks", nargs="+", choices=DISKS, default=DISKS, metavar="DISK", help=", ".join(DISKS))
    parser.add_argument("--outages", type=int, default=5)
    parser.add_argument("--outage-seconds", type=float, default=30.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path, metavar="FILE")
    return parser.parse_args()


def timed(writer: Writer, path: Path) -> float:
    """The seconds of a process that nothing happens to."""
    begun = time.monotonic()
    attempt(writer, path, kill_after=None)
    return time.monotonic() - begun


def measured(options: argparse.Namespace, folder: Path) -> list[Row]:
    """Everything that was asked for, each row printed when it is done."""
    rows: list[Row] = []
    seed, trainer = options.seed, real_writer(options.real_frames)
    real_seconds = timed(trainer, folder / "real")
    sent: Sent = repeated(open_stream(folder / "real"), frames=FRAMES)
    periods = repeated(open_stream(folder / "real"), frames=FRAMES, each_a_period=True)

    def add(row: Row) -> None:
        rows.append(row)
        print(table([row]).splitlines()[-1], flush=True)

    writers = {
        "segments": (sent, segments_writer(sent)),
        "file": (sent, file_writer(sent)),
        "segments of 8 periods": (periods, segments_writer(periods)),
        "file of 8 periods": (periods, file_writer(periods)),
    }
    for name in options.of:
        stream, writer = writers[name]
        limit = timed(writer, folder / name)
        row = Row(f"kill -9, {name}")
        add(killed_streams(row, writer, kills=options.kills, whole=stream.whole, folder=folder, seed=seed, limit=limit))
    if options.real:
        whole, row = content(folder / "real"), Row("kill -9, trainer and segments")
        limit = real_seconds
        add(killed_streams(row, trainer, kills=options.real, whole=whole, folder=folder, seed=seed, limit=limit))
    try:
        for disk in options.disks:
            row = Row(f"disk full, {disk} before")
            add(full_disks(row, sent, count=options.full, folder=folder, seed=seed, margin=disk == "seen"))
    except PermissionError as error:
        print(f"No small disk can be mounted here ({error}).")
    if options.outages:
        row = Row(f"target out of reach for {options.outage_seconds:g} s")
        add(outages(row, sent, count=options.outages, seconds=options.outage_seconds, folder=folder, seed=seed))
    return rows


def main() -> None:
    """Do everything that was asked for, and print the table."""
    options = parsed()
    with tempfile.TemporaryDirectory() as name:
        rows = measured(options, Path(name))
    print(table(rows))
    if options.json:
        options.json.write_text(json.dumps([asdict(row) for row in rows], indent=1) + "\n")


if __name__ == "__main__":
    main()
