# SPDX-License-Identifier: Apache-2.0
"""Cameras that go wrong, servers and trainers that are killed, at random moments while others watch.

    python -m lab.robustness.faults --json lab/results/faults.json
    python -m lab.robustness.faults --only cut server --moments 12 --kills 5       (a trial)
    python -m lab.robustness.faults table lab/results/faults.json

Eleven cameras and a held-out one send coded pictures from this machine, and each goes wrong at moments that are drawn
with a seed (``fault_film``); what the trainer gets is compared with what was filmed (``fault_cameras``). Then servers
and trainers are killed by SIGKILL while players without a picture check every byte, and a page in Chromium plays on
(``fault_viewers``; needs pytest and Chromium, ``--no-page`` does without); the *trainer that fits* is the real one, the
others write prepared packets, one of them with another period every eighth frame, near whose borders it is killed.
``kills`` has what needs no viewers: trainers killed and their streams continued, full disks; ``store_outages`` targets
in trouble. A row that the JSON file has is not made again.
"""

import argparse
import json
import logging
import os
import sys
import tempfile
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from benchmarks.machine import load_average, machine
from lab.robustness.fault_cameras import FILMED, camera_faults
from lab.robustness.fault_fits import killed_fits
from lab.robustness.fault_report import table
from lab.robustness.fault_viewers import killed_servers, killed_trainers
from lab.robustness.kills import started
from lab.robustness.stream_writers import Sent, real_writer, repeated
from structgstream.codec.reader import open_stream

FRAMES = 4096
PERIOD_FRAMES = 512
PERIODS = "trainer across periods"
KILLED = ("server", "trainer", PERIODS)
FITS = "trainer that fits"


@dataclass(frozen=True)
class Prepared:
    """Packets of the bundled clip, fitted for a moment.

    Args:
        plain: of one period.
        periods: every eighth frame begins another.
    """

    plain: Sent
    periods: Sent

    @classmethod
    def made(cls) -> "Prepared":
        """Fits, in a process of its own: one that has used OpenMP's threads cannot fork another that fits."""
        with tempfile.TemporaryDirectory(prefix="faults-") as name:
            child, reading = started(real_writer(8), Path(name) / "clip")
            os.waitpid(child, 0)
            os.close(reading)
            reader = open_stream(Path(name) / "clip")
            return cls(repeated(reader, frames=FRAMES), repeated(reader, frames=PERIOD_FRAMES, each_a_period=True))


def row_of(what: str, sent: Prepared, options: argparse.Namespace, folder: Path) -> dict[str, Any]:
    """A row of the result."""
    if what in FILMED:
        return asdict(camera_faults(what, sent.plain, moments=options.moments, seed=options.seed, folder=folder))
    common: dict[str, Any] = {
        "kills": options.kills, "seed": options.seed, "folder": folder, "players": options.players,
        "page": options.page,
    }  # fmt: skip
    if what == FITS:
        return asdict(killed_fits(**{**common, "kills": options.fits}))
    if what == "server":
        return asdict(killed_servers(sent.plain, down_seconds=options.down_seconds, **common))
    return asdict(killed_trainers(sent.periods if what == PERIODS else sent.plain, **common))


def measured(options: argparse.Namespace, done: Callable[[dict[str, Any]], object]) -> dict[str, Any]:
    """Everything that was asked for and is not there; ``done`` is given the result after each row."""
    result: dict[str, Any] = {"cameras": [], "viewers": [], "machine": machine()}
    if options.json and options.json.exists():
        result |= json.loads(options.json.read_text())
    there = {(row["what"], row["seed"]) for kind in ("cameras", "viewers") for row in result[kind]}
    asked = [what for what in options.only if (what, options.seed) not in there]
    sent = Prepared.made() if asked else None
    for what in asked:
        assert sent is not None
        with tempfile.TemporaryDirectory(prefix="faults-") as name:
            row = row_of(what, sent, options, Path(name))
        row |= {"load_average": load_average(), "commit": machine()["commit"]}
        result["cameras" if what in FILMED else "viewers"].append(row)
        done(result)
    return result


def parsed(arguments: list[str] | None = None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(
        prog="python -m lab.robustness.faults",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    every = (*FILMED, *KILLED, FITS)
    parser.add_argument("--only", nargs="+", choices=every, default=every, metavar="WHAT", help=", ".join(every))
    parser.add_argument("--moments", type=int, default=204, help="of each fault of cameras")
    parser.add_argument("--kills", type=int, default=200, help="of servers and of trainers")
    parser.add_argument("--fits", type=int, default=10, help="kills of a trainer that fits the bundled clip")
    parser.add_argument("--players", type=int, default=8, help="that check bytes")
    parser.add_argument("--no-page", dest="page", action="store_false", help="without Chromium")
    parser.add_argument("--down-seconds", type=float, default=1.0, help="at most, until a server is started again")
    parser.add_argument("--seed", type=int, default=0, help="another one adds rows to the file")
    parser.add_argument("--json", type=Path, metavar="FILE")
    return parser.parse_args(arguments)


def main() -> None:
    """Measures, or prints a result as Markdown."""
    if sys.argv[1:2] == ["table"]:
        print(table(json.loads(Path(sys.argv[2]).read_text())))
        return
    options = parsed()
    logging.getLogger("structgstream").setLevel(logging.ERROR)  # what is wrong is wanted here

    def done(result: dict[str, Any]) -> None:
        if options.json:
            options.json.write_text(json.dumps(result, indent=1) + "\n")

    print(table(measured(options, done)))


if __name__ == "__main__":
    main()
