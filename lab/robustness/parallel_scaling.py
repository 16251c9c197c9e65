# SPDX-License-Identifier: Apache-2.0
"""What engines cost, and what workers bring: seconds and memory, in processes and on Ray, on this machine.

    python -m lab.robustness.parallel_scaling --folder FOLDER
    python -m lab.robustness.parallel_scaling --folder FOLDER --runs local-1 local-2    (a part)

Three tables: whole runs of the bundled clip (12 frames, preset tiny, groups of 2, workers of one thread) by engine and
number of workers; the overhead of an engine, from tasks that do nothing; and the memory of a driver that has planned
10,000 groups, of which workers are doing the first. Each row is a process of its own; memory is the proportional set
size of the process and of all that it began.
"""

import argparse
import json
import os
import subprocess
import sys
import threading
import time
from collections import defaultdict
from pathlib import Path

from structgstream.data.dataset_layouts import bundled_clip_path
from structgstream.executors.tasks import ExecutorName, ExecutorOptions, Task, open_executor
from structgstream.parallel.driver import Job, State, Status, Unit, drive
from structgstream.parallel.parts import Parts
from tests.support.stand_ins import PROGRAM, sha256

ROWS = ("local-1", "local-2", "ray-1", "ray-2")
EMPTY_TASKS = 40
PLANNED = 10_000
ENOUGH = 40  # groups done, after which memory no longer changes


def options_of(row: str) -> ExecutorOptions:
    """The engine and the workers that a row names."""
    name, _, workers = row.partition("-")
    engine: ExecutorName = "ray" if name == "ray" else "local"
    return ExecutorOptions(engine, int(workers), threads=1)


class Memory:
    """The most memory, in bytes, of this process and of those below it, looked at four times a second."""

    def __init__(self) -> None:
        self.own = self.below = self.processes = 0
        self._done = threading.Event()
        self._thread = threading.Thread(target=self._look, daemon=True)

    def __enter__(self) -> "Memory":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._done.set()
        self._thread.join()

    def _look(self) -> None:
        while not self._done.wait(0.25):
            others = descendants(own := "self")
            self.own = max(self.own, proportional_bytes(own))
            below = sum(map(proportional_bytes, others))
            if below > self.below:
                self.below, self.processes = below, len(others)


def proportional_bytes(pid: str) -> int:
    """The proportional set size of a process; 0 when it is gone."""
    try:
        lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
    except OSError:
        return 0
    return next((int(line.split()[1]) * 1024 for line in lines if line.startswith("Pss:")), 0)


def descendants(pid: str) -> list[str]:
    """Ids of all processes below one."""
    children = defaultdict[str, list[str]](list)
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            children[stat.read_text().rsplit(")", 1)[1].split()[1]].append(stat.parent.name)
        except OSError:
            continue
    found, look = list[str](), [Path(f"/proc/{pid}").resolve().name]
    while look:
        below = children[look.pop()]
        found += below
        look += below
    return found


def whole_run(row: str, folder: Path) -> dict[str, object]:
    """A real run."""
    folder.mkdir(parents=True)
    unit = Unit(
        str(bundled_clip_path()),
        header=("--preset", "tiny"),
        track=("--groups", "2", "--allow-unaligned"),
        device=("--device", "cpu"),
    )
    parts = Parts(folder / "parts")
    begun = time.monotonic()
    with Memory() as memory, open_executor(options_of(row), cores=2) as executor, parts.locked():
        opened = time.monotonic() - begun
        drive(Job(unit, folder / "out.sgs"), parts, executor)
        seconds = time.monotonic() - begun
    notes = parts.completed
    groups = sum(note.seconds for name, note in notes.items() if name.startswith("group"))
    return {
        "seconds": seconds,
        "opening": opened,
        "header": notes["header"].seconds,
        "track": notes["track"].seconds,
        "groups together": groups,
        "join": notes["join"].seconds,
        "driver": memory.own,
        "below it": memory.below,
        "sha256": sha256(folder / "out.sgs")[:8],
    }


def overhead(row: str) -> dict[str, object]:
    """Tasks that do nothing."""
    begun = time.monotonic()
    with Memory() as memory:
        with open_executor(options_of(row), cores=2) as executor:
            opened = time.monotonic() - begun
            for i in range(EMPTY_TASKS):
                executor.submit(Task(f"{i}", ("true",)))
            first, ended = 0.0, 0
            while ended < EMPTY_TASKS:
                ended += len(executor.wait(1.0))
                first = first or time.monotonic() - begun - opened
            each = (time.monotonic() - begun - opened - first) / (EMPTY_TASKS - 1)
            closing = time.monotonic()
        closed = time.monotonic() - closing
    return {
        "opening": opened,
        "first task": first,
        "each further": each,
        "closing": closed,
        "driver": memory.own,
        "below it": memory.below,
        "processes": memory.processes,
    }


class Enough(Exception):
    """Memory has been seen."""


def planned(row: str, folder: Path) -> dict[str, object]:
    """A driver that has planned 10,000 groups of commands that only look real."""
    folder.mkdir(parents=True)
    os.environ["STAND_IN_SECONDS"] = "0.001"
    unit = Unit("capture", PLANNED, track=("--groups", "1"), program=PROGRAM)
    parts, begun, seen = Parts(folder / "parts"), time.monotonic(), list[float]()

    def tell(status: Status) -> None:
        if len(status.states) == PLANNED and State.UNTRACKED not in status.states:
            seen.append(time.monotonic() - begun)
            if sum(state == "done" for state in status.states) >= ENOUGH:
                raise Enough

    with Memory() as memory:
        try:
            with open_executor(options_of(row), cores=2) as executor, parts.locked():
                drive(Job(unit, folder / "out.sgs"), parts, executor, listener=tell)
        except Enough:
            time.sleep(0.5)
    return {"seconds until all were planned": seen[0], "driver": memory.own, "below it": memory.below}


def row_of(kind: str, row: str, folder: Path) -> dict[str, object]:
    """One row, in a process of its own."""
    command = [sys.executable, "-m", "lab.robustness.parallel_scaling", "--folder", str(folder), "--one", kind, row]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
    return json.loads(done.stdout.splitlines()[-1])


def shown(key: str, value: object) -> str:
    """A number with its unit."""
    if not isinstance(value, float | int):
        return str(value)
    if key in ("driver", "below it"):
        return f"{value / 1e6:.0f} MB"
    return f"{value:.2f} s" if isinstance(value, float) else str(value)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path, required=True, help="for runs; must not exist")
    parser.add_argument("--runs", nargs="*", default=ROWS, choices=ROWS)
    parser.add_argument("--empty", nargs="*", default=ROWS, choices=ROWS)
    parser.add_argument("--planned", nargs="*", default=("local-2", "ray-2"), choices=ROWS)
    parser.add_argument("--one", nargs=2)
    options = parser.parse_args()
    if options.one:
        kind, row = options.one
        folder = options.folder / f"{kind}-{row}"
        made = {"runs": whole_run, "planned": planned}
        print(json.dumps(made[kind](row, folder) if kind in made else overhead(row)))
        return
    for kind in ("empty", "planned", "runs"):
        for i, row in enumerate(getattr(options, kind)):
            result = row_of(kind, row, options.folder)
            if not i:
                print(f"\n| {kind} | {' | '.join(result)} |\n{'|---' * (len(result) + 1)}|")
            print(f"| {row} | {' | '.join(shown(key, value) for key, value in result.items())} |", flush=True)


if __name__ == "__main__":
    main()
