# SPDX-License-Identifier: Apache-2.0
"""Parallel runs whose workers and drivers are killed, whose segments are cut or flipped, and whose store refuses.

    python -m lab.robustness.parallel_faults
    python -m lab.robustness.parallel_faults --kills 5 --driver-kills 5 --damages 5 --drivers 2 --stores 1    (a trial)
    python -m lab.robustness.parallel_faults --real 6 --kills 0 --driver-kills 0 --damages 0 --drivers 0 --stores 0

Every run must end with the bytes of one that nothing happened to. The commands are those of
``tests/support/stand_in.py``, which write, lock and go on as the real ones do; ``--real`` takes the real ones, too, on
the bundled clip with the preset tiny at a quarter of its size in groups of 4, and once a store that refuses. Moments
are drawn with a seed; where in a write they fall is not.
"""

import argparse
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from structgstream.data.dataset_layouts import bundled_clip_path
from structgstream.errors import StorageError, TaskError
from structgstream.executors.tasks import LocalEngine, TaskQueue, WorkerSlot
from structgstream.parallel.driver import Job, Unit, drive
from structgstream.parallel.exchange import ObjectFolder, ObjectStore
from structgstream.parallel.parts import Parts
from tests.support.flaky_store import flaky_store
from tests.support.stand_ins import PROGRAM, sha256


@dataclass
class Row:
    """What happened, how often, and what came of it."""

    what: str
    events: int = 0
    runs: int = 0
    equal: int = 0
    begun_again: int = 0
    remark: str = ""


def job_in(folder: Path, *, real: bool) -> Job:
    """Three real groups of four frames, or twenty that only look so."""
    folder.mkdir(parents=True, exist_ok=True)
    if real:
        track = ("--groups", "4", "--allow-unaligned")
        unit = Unit(
            str(bundled_clip_path()),
            header=("--preset", "tiny", "--scale", "0.25"),
            track=track,
            device=("--device", "cpu"),
        )
    else:
        track = ("--groups", "4")
        unit = Unit("capture", 80, track=track, program=PROGRAM)
    return Job(unit, folder / "out.sgs")


def driven(folder: Path, engine: LocalEngine, *, real: bool, url: str | None = None) -> str:
    """Drives to the end, and returns the hash of the stream.

    Raises:
        TaskError: a task failed, or was killed too often.
        StorageError: another driver is at work.
    """
    given, parts = job_in(folder, real=real), Parts(folder / "parts")
    with parts.locked(), TaskQueue(engine) as executor:
        exchange = None if url is None else ObjectStore(ObjectFolder(url), parts)
        drive(given, parts, executor, exchange=exchange)
    return sha256(given.output)


def engine() -> LocalEngine:
    """Two workers of one thread."""
    return LocalEngine([WorkerSlot(1)] * 2)


def killed_workers(row: Row, folder: Path, *, whole: str, kills: int, most: float, seed: int, real: bool) -> Row:
    """Kills a random worker at random moments, until there were enough kills."""
    rng = random.Random(seed)
    while row.events < kills:
        run, done = folder / f"{row.runs}", threading.Event()
        workers = engine()

        def killer(workers: LocalEngine = workers, done: threading.Event = done) -> None:
            while not done.wait(rng.uniform(0, most)) and row.events < kills:
                pids = list(workers.processes.values())
                if pids:
                    row.events += 1
                    os.kill(rng.choice(pids), signal.SIGKILL)

        thread = threading.Thread(target=killer)
        thread.start()
        while True:
            try:
                found = driven(run, workers, real=real)
                break
            except TaskError:
                row.begun_again += 1
        done.set()
        thread.join()
        row.runs += 1
        row.equal += found == whole
        shutil.rmtree(run)
    return row


def driver(folder: Path, *, real: bool) -> subprocess.Popen[bytes]:
    """A driver in a process of its own."""
    command = [sys.executable, "-m", "lab.robustness.parallel_faults", "--drive", str(folder)]
    return subprocess.Popen([*command, *(["--real", "1"] if real else [])], stderr=subprocess.PIPE)


def killed_drivers(row: Row, folder: Path, *, whole: str, kills: int, most: float, seed: int, real: bool) -> Row:
    """Kills the driver at random moments, and begins it again, until the stream is there."""
    rng = random.Random(seed)
    while row.events < kills:
        run = folder / f"{row.runs}"
        while True:
            process = driver(run, real=real)
            try:
                _, said = process.communicate(timeout=rng.uniform(0, 2 * most) if row.events < kills else None)
            except subprocess.TimeoutExpired:
                process.kill()
                process.communicate()
                row.events += 1
                row.begun_again += 1
                continue
            if process.returncode:
                raise SystemExit(f"A driver failed: {said.decode()}")
            break
        row.runs += 1
        row.equal += sha256(run / "out.sgs") == whole
        shutil.rmtree(run)
    return row


def damaged_segments(row: Row, folder: Path, *, whole: str, count: int, seed: int, real: bool) -> Row:
    """Cuts a segment, or flips a bit of it, between two runs; the second also finds the stream gone."""
    rng, run = random.Random(seed), folder / "damaged"
    driven(run, engine(), real=real)
    for i in range(count):
        victim = rng.choice(sorted((run / "parts" / "segments").glob("*.sgs")))
        data = bytearray(victim.read_bytes())
        if i % 2:
            data = data[: rng.randrange(len(data))]
        else:
            data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
        victim.write_bytes(data)
        (run / "out.sgs").unlink()
        row.events += 1
        row.runs += 1
        row.equal += driven(run, engine(), real=real) == whole
    return row


def two_drivers(row: Row, folder: Path, *, whole: str, count: int, seed: int, real: bool) -> Row:
    """Begins two drivers of one output; one is refused, or both end."""
    rng, refused = random.Random(seed), 0
    for i in range(count):
        run = folder / f"two-{i}"
        first = driver(run, real=real)
        time.sleep(rng.uniform(0, 1.0))
        second = driver(run, real=real)
        ended = [process.communicate()[1].decode() for process in (first, second)]
        said = [text for text, process in zip(ended, (first, second)) if process.returncode]
        refused += sum("Another process makes the parts" in text for text in said)
        if any("Another process makes the parts" not in text for text in said):
            raise SystemExit(f"A driver failed: {said}")
        row.events += 1
        row.runs += 1
        row.equal += sha256(run / "out.sgs") == whole
        shutil.rmtree(run)
    row.remark = f"{refused} refused"
    return row


def refusing_store(row: Row, folder: Path, *, whole: str, count: int, real: bool) -> Row:
    """Runs by an object store that refuses every tenth request."""
    os.environ["STRUCTGSTREAM_SCRATCH"] = str(folder)
    for i in range(count):
        with flaky_store(10) as (url, application):
            row.equal += driven(folder / f"store-{i}", engine(), real=real, url=f"{url}-{i}") == whole
            row.events += application.refused
            row.remark = f"{application.requests} requests in the last"
        row.runs += 1
    return row


def table(rows: Sequence[Row]) -> str:
    """The rows as Markdown."""
    heads = ("what", "events", "runs", "equal bytes", "begun again", "remark")
    lines = [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
    return "\n".join([*lines, *(f"| {' | '.join(str(value) for value in asdict(row).values())} |" for row in rows)])


def parsed() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=50, help="of workers")
    parser.add_argument("--driver-kills", type=int, default=50)
    parser.add_argument("--damages", type=int, default=20)
    parser.add_argument("--drivers", type=int, default=6, help="pairs of drivers of one output")
    parser.add_argument(
        "--stores", type=int, default=3, help="runs by an object store that refuses every tenth request"
    )
    parser.add_argument(
        "--real", type=int, default=0, help="kills of real workers, of real drivers, damages; and a store"
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--drive", type=Path, metavar="FOLDER", help="drive one run to its end, and no more")
    parser.add_argument("--json", type=Path, metavar="FILE")
    return parser.parse_args()


def measured(options: argparse.Namespace, folder: Path) -> list[Row]:
    """Everything that was asked for, each row printed when it is done."""
    rows: list[Row] = []
    seed = options.seed

    def add(make: Callable[[Row], Row], what: str, *, when: int) -> None:
        if when:
            rows.append(make(Row(what)))
            print(table(rows[-1:]).splitlines()[-1], flush=True)

    def series(real: bool, kills: int, driver_kills: int, damages: int) -> None:
        kind, place = ("real, " if real else ""), folder / ("real" if real else "stand-in")
        begun = time.monotonic()
        whole = driven(place / "whole", engine(), real=real)
        seconds = time.monotonic() - begun
        common = {"whole": whole, "seed": seed, "real": real}
        most = seconds / 4
        add(
            lambda row: killed_workers(row, place, kills=kills, most=most, **common), f"{kind}worker killed", when=kills
        )
        add(
            lambda row: killed_drivers(row, place, kills=driver_kills, most=seconds, **common),
            f"{kind}driver killed",
            when=driver_kills,
        )
        add(
            lambda row: damaged_segments(row, place, count=damages, **common),
            f"{kind}segment cut or flipped",
            when=damages,
        )
        pairs, stores = (0, 1) if real else (options.drivers, options.stores)
        add(lambda row: two_drivers(row, place, count=pairs, **common), "two drivers of one output", when=pairs)
        del common["seed"]
        add(
            lambda row: refusing_store(row, place, count=stores, **common),
            f"{kind}request refused, 1 in 10",
            when=stores,
        )

    if options.kills or options.driver_kills or options.damages or options.drivers or options.stores:
        series(False, options.kills, options.driver_kills, options.damages)
    if options.real:
        series(True, options.real, options.real, options.real)
    return rows


def main() -> int:
    """Do everything that was asked for, and print the table."""
    options = parsed()
    if options.drive is not None:
        try:
            driven(options.drive, engine(), real=bool(options.real))
        except (StorageError, TaskError) as error:
            print(error, file=sys.stderr)
            return 1
        return 0
    with tempfile.TemporaryDirectory() as name:
        rows = measured(options, Path(name))
    print(table(rows))
    if options.json:
        options.json.write_text(json.dumps([asdict(row) for row in rows], indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
