# SPDX-License-Identifier: Apache-2.0
"""What many players cost: ``structgstream serve`` beside a trainer, and against plain static servers.

``python -m lab.robustness.load STREAM --json lab/results/load.json`` writes segments of STREAM's packets with a process
that stands for a trainer, serves them, and lets players come and go, half of them slow (10 kB/s). Then the same files
are fetched from this server, nginx (where it is installed) and Python's own, in turns.
``python -m lab.robustness.load table FILE`` prints a result as Markdown.
"""

import argparse
import hashlib
import json
import os
import re
import shutil
import signal
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from benchmarks.machine import load_average, machine
from lab.robustness.load_fetch import fetched, rates

NAME = "live"
PATIENCE_SECONDS = 60.0
SERVER_NICE = 5  # as in deploy/structgstream-serve.service
PLAYERS_NICE = 19  # they stand for other machines


class Watched:
    """A process's memory in use, sampled twice a second until the end of the block."""

    def __init__(self, process: int) -> None:
        self._status = Path(f"/proc/{process}/status")
        self._ended = threading.Event()
        self.samples: list[tuple[float, int]] = []
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> "Watched":
        self._thread.start()
        return self

    def __exit__(self, *raised: object) -> None:
        self._ended.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._ended.wait(0.5):
            found = re.search(r"VmRSS:\s+(\d+) kB", self._status.read_text())
            self.samples.append((time.monotonic(), int(found[1]) * 1024 if found else 0))

    def most(self, between: tuple[float, float] = (0.0, float("inf"))) -> int:
        """The largest in a span of time, in bytes; 0 without samples."""
        return max((size for at, size in self.samples if between[0] <= at < between[1]), default=0)


@contextmanager
def process(*command: str, output: int | None = None, nice: int = 0) -> Iterator["subprocess.Popen[str]"]:
    """A Python module in a process of its own, with a lower priority by ``nice``, which ends with the block."""
    lower = ["nice", "-n", str(nice)] if nice else []
    running = subprocess.Popen([*lower, sys.executable, "-m", *command], stdout=output, text=True)
    try:
        yield running
    finally:
        if running.poll() is None:
            running.terminate()
        running.wait(PATIENCE_SECONDS)
        if running.stdout is not None:
            running.stdout.close()


@contextmanager
def serving(folder: Path, *, nice: int = 0) -> Iterator[tuple[str, int]]:
    """The server on a free port, with limits that a single address may use up; its address and its process."""
    command = ("structgstream", "serve", str(folder), "--port", "0", "--connections", "2000")
    with process(*command, output=subprocess.PIPE, nice=nice) as running:
        assert running.stdout is not None
        found = re.search(r"http://\S+/", running.stdout.readline())
        assert found, "the server tells its address"
        yield found[0], running.pid


def processor_seconds(process: int) -> float:
    """What a process has taken of the processor since it began."""
    values = Path(f"/proc/{process}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(values[11]) + int(values[12])) / os.sysconf("SC_CLK_TCK")


def live(stream: Path, work: Path, options: argparse.Namespace) -> dict[str, Any]:
    """A trainer, the server, and players that come and go."""
    folder, log = work / "streams" / NAME, work / "trainer.jsonl"
    folder.parent.mkdir()
    trainer_options = ("--renderings", str(options.renderings), "--log", str(log))
    spans: list[dict[str, Any]] = []
    with process("lab.robustness.load_trainer", str(folder), str(stream), *trainer_options) as trainer:
        wait_for(folder / "manifest.json", trainer)
        with serving(folder.parent, nice=SERVER_NICE) as (address, server), Watched(server) as memory:
            time.sleep(2.0)
            for _ in range(options.rounds):
                began, busy = time.monotonic(), processor_seconds(server)
                time.sleep(options.alone_seconds)
                busy = processor_seconds(server) - busy
                spans.append({"players": 0, "span": (began, time.monotonic()), "server_busy": busy})
                began, busy = time.monotonic(), processor_seconds(server)
                counts = ("--fast", str(options.players - options.players // 2), "--slow", str(options.players // 2))
                command = ("lab.robustness.load_players", f"{address}streams/{NAME}/", *counts)
                seconds = ("--seconds", str(options.seconds))
                with process(*command, *seconds, output=subprocess.PIPE, nice=PLAYERS_NICE) as players:
                    assert players.stdout is not None
                    found = json.loads(players.stdout.read())
                busy, span = processor_seconds(server) - busy, (began, time.monotonic())
                spans.append({"players": options.players, "span": span, "found": found, "server_busy": busy})
            trainer.send_signal(signal.SIGTERM)
            trainer.wait(PATIENCE_SECONDS)
            busy = processor_seconds(server)
    frames = [json.loads(line) for line in log.read_text().splitlines()]
    for one in spans:
        one["server_bytes"] = memory.most(one["span"])
    return {
        "spans": [judged(one, frames, folder) for one in spans],
        "server": {
            "before_bytes": memory.samples[0][1],
            "max_bytes": memory.most(),
            "processor_seconds": busy,
            "seconds": memory.samples[-1][0] - memory.samples[0][0],
        },
    }


def wait_for(file: Path, running: "subprocess.Popen[str]") -> None:
    """Waits until a process has written a file."""
    last = time.monotonic() + PATIENCE_SECONDS
    while not file.exists():
        assert running.poll() is None, "it is running"
        assert time.monotonic() < last, file
        time.sleep(0.1)


def judged(span: dict[str, Any], frames: list[dict[str, float]], folder: Path) -> dict[str, Any]:
    """A span of time: the trainer's frames in it, and what the players got. Frames while players join are left out."""
    began, ended = span["span"]
    players = span.get("found", {"fast": [], "slow": [], "processor_seconds": 0.0})
    joined = [one["joined_seconds"] for one in players["fast"]]
    joined_by = began + max((one for one in joined if one is not None), default=0.0)
    inside = [one for one in frames if one["began"] >= joined_by and one["began"] + one["fit_seconds"] < ended]
    delays = sorted(delay for one in players["fast"] for delay in one["delays_seconds"])
    found: dict[str, Any] = {
        "players": span["players"],
        "seconds": ended - began,
        "server_bytes": span["server_bytes"],
        "fit_seconds": [one["fit_seconds"] for one in inside],
        "busy_seconds": [one["busy_seconds"] for one in inside],
        "write_seconds": [one["write_seconds"] for one in inside],
        "waited_seconds": [one["waited_seconds"] for one in inside],
        "processor_seconds": {"server": span["server_busy"], "players": players["processor_seconds"]},
    }
    if span["players"]:
        right = digests(folder)
        found["joined_seconds"] = {"median": _median(joined), "most": joined_by - began}
        found["fast"] = {
            "players": len(players["fast"]),
            "joined": sum(one is not None for one in joined),
            "exact": sum(right.get(one["frames"]) == one["digest"] and not one["wrong"] for one in players["fast"]),
            "least_frames": min(one["frames"] for one in players["fast"]),
            "most_frames": max(one["frames"] for one in players["fast"]),
            "bytes": sum(one["bytes"] for one in players["fast"]),
            "broken": sum(one["broken"] for one in players["fast"]),
            "delay_seconds": {
                "median": statistics.median(delays) if delays else None,
                "95%": delays[int(0.95 * len(delays))] if delays else None,
                "most": delays[-1] if delays else None,
            },
        }
        found["slow"] = {
            "players": len(players["slow"]),
            "bytes": sum(one["bytes"] for one in players["slow"]),
            "wrong": sum(len(one["wrong"]) for one in players["slow"]),
            "broken": sum(one["broken"] for one in players["slow"]),
        }
    return found


def _median(values: list[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return statistics.median(known) if known else None


def listed(folder: Path, page: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """The entries of all segments of a manifest or a history page, in order."""
    for entry in page.get("history", ()):
        yield from listed(folder, json.loads((folder / entry["file"]).read_bytes()))
    yield from page.get("segments", ())


def digests(folder: Path) -> dict[int, str]:
    """SHA-256 of the init record and the first so many frames, by their number."""
    manifest = json.loads((folder / "manifest.json").read_bytes())
    total = hashlib.sha256((folder / manifest["periods"][0]["file"]).read_bytes())
    found = {0: total.hexdigest()}
    for entry in listed(folder, manifest):
        content, start = (folder / entry["file"]).read_bytes(), 0
        for number, size in enumerate(entry["frame_bytes"], entry["first_frame"] + 1):
            total.update(content[start : start + size])
            start += size
            found[number] = total.hexdigest()
    return found


def throughput(stream: Path, work: Path, options: argparse.Namespace) -> dict[str, Any]:
    """The same files from every server, in turns: MB/s of large files, and answers a second of small ones."""
    folder = work / "streams"
    files = {
        kind: sorted(str(path.relative_to(folder)) for path in folder.glob(f"{NAME}/{pattern}"))
        for kind, pattern in (("init", "init-*"), ("segments", "segment-*"), ("manifest", "manifest.json"))
    }
    found: dict[str, Any] = {kind: {} for kind in files}
    with serving(folder) as (ours, us), static_python(folder) as python, static_nginx(folder, work) as nginx:
        servers = {"serve": (f"{ours}streams/", us), "python -m http.server": python}
        if nginx is not None:
            servers["nginx"] = nginx
        for kind, names in files.items():
            for _ in range(options.turns):
                for server, (address, number) in servers.items():
                    before = processor_seconds(number)
                    outcome = fetched(address, names, connections=options.connections, seconds=options.turn_seconds)
                    busy = processor_seconds(number) - before
                    found[kind].setdefault(server, []).append(replace(outcome, busy_seconds=busy))
    return {kind: rates(outcomes, folder, files[kind]) for kind, outcomes in found.items()}


@contextmanager
def static_python(folder: Path) -> Iterator[tuple[str, int]]:
    """The standard library's server of a folder: its address and its process."""
    command = ("http.server", "0", "--bind", "127.0.0.1", "--directory", str(folder), "--protocol", "HTTP/1.1")
    running = subprocess.Popen(
        [sys.executable, "-u", "-m", *command], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    )
    try:
        assert running.stdout is not None
        found = re.search(r"http://\S+/", running.stdout.readline())
        assert found, "the server tells its address"
        yield found[0], running.pid
    finally:
        running.terminate()
        running.wait(PATIENCE_SECONDS)
        if running.stdout is not None:
            running.stdout.close()


@contextmanager
def static_nginx(folder: Path, work: Path) -> Iterator[tuple[str, int] | None]:
    """nginx with one process, as an ordinary static server; None where it is not installed."""
    program = shutil.which("nginx")
    if program is None:
        yield None
        return
    from lab.robustness.load_fetch import free_port, nginx_configuration

    port = free_port()
    configuration = work / "nginx.conf"
    configuration.write_text(nginx_configuration(folder, work, port))
    running = subprocess.Popen([program, "-c", str(configuration), "-e", str(work / "nginx.log")])
    try:
        time.sleep(1.0)
        assert running.poll() is None, (work / "nginx.log").read_text()
        yield f"http://127.0.0.1:{port}/", running.pid
    finally:
        running.terminate()
        running.wait(PATIENCE_SECONDS)


def parsed(arguments: list[str] | None = None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(prog="python -m lab.robustness.load", description=__doc__)
    parser.add_argument("stream", type=Path, help="whose packets are written")
    parser.add_argument("--players", type=int, default=200)
    parser.add_argument("--renderings", type=int, default=10, help="of the trainer's stand-in, a frame")
    parser.add_argument("--rounds", type=int, default=3, help="without players, then with them")
    parser.add_argument("--alone-seconds", type=float, default=40.0)
    parser.add_argument("--seconds", type=float, default=100.0, help="with players")
    parser.add_argument("--connections", type=int, default=16, help="of the comparison with static servers")
    parser.add_argument("--turns", type=int, default=5)
    parser.add_argument("--turn-seconds", type=float, default=3.0)
    parser.add_argument("--json", type=Path, metavar="FILE")
    return parser.parse_args(arguments)


def measured(options: argparse.Namespace) -> dict[str, Any]:
    """Everything that was asked for."""
    before = load_average()
    with tempfile.TemporaryDirectory(prefix="load-") as name:
        work = Path(name)
        found = {"live": live(options.stream, work, options), "throughput": throughput(options.stream, work, options)}
    return {
        "command": " ".join(["python -m lab.robustness.load", *sys.argv[1:]]),
        "machine": machine(),
        "load_average": {"before": before, "after": load_average()},
        **found,
    }


def main() -> None:
    """Measures, or prints a result as Markdown."""
    from lab.robustness.load_report import table

    if sys.argv[1:2] == ["table"]:
        print(table(json.loads(Path(sys.argv[2]).read_text())))
        return
    options = parsed()
    result = measured(options)
    print(table(result))
    if options.json:
        options.json.write_text(json.dumps(result, indent=2) + "\n")


if __name__ == "__main__":
    main()
