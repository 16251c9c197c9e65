# SPDX-License-Identifier: Apache-2.0
"""Memory of trainer and server over a stream that runs for long: frames as fast as they can be written.

``python -m lab.robustness.long_stream STREAM --seconds 320`` writes STREAM's packets over and over as segments without
any fit, serves them to four players that check every byte, and prints the memory of both processes every ten seconds.
"""

import argparse
import json
import subprocess
import tempfile
import time
from pathlib import Path

from lab.robustness.load import NAME, Watched, process, serving, wait_for

PLAYERS = 4


def main() -> None:
    """Prints a line every ten seconds, and what the players got."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("stream", type=Path)
    parser.add_argument("--seconds", type=float, default=320.0)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as work:
        folder = Path(work) / "streams" / NAME
        folder.parent.mkdir()
        unfitted = ("--renderings", "0", "--log", str(Path(work) / "log"))
        with process("lab.robustness.load_trainer", str(folder), str(options.stream), *unfitted) as trainer:
            wait_for(folder / "manifest.json", trainer)
            with (
                serving(folder.parent) as (address, server),
                Watched(server) as served,
                Watched(trainer.pid) as trained,
            ):
                command = (
                    "lab.robustness.load_players",
                    f"{address}streams/{NAME}/",
                    "--fast",
                    str(PLAYERS),
                    "--slow",
                    "0",
                )
                ends = time.monotonic() + options.seconds
                with process(*command, "--seconds", str(options.seconds), output=subprocess.PIPE) as players:
                    while time.monotonic() < ends:
                        time.sleep(min(10.0, max(ends - time.monotonic(), 0.0)))
                        edge = json.loads((folder / "manifest.json").read_bytes())["edge"]["frame"]
                        memory = [one.samples[-1][1] / 1e6 for one in (trained, served) if one.samples]
                        print(f"{edge} frames: trainer, server", *(f"{size:.0f} MB" for size in memory), flush=True)
                    assert players.stdout is not None
                    found = json.loads(players.stdout.read())["fast"]
    print(
        "frames of the players:", *(one["frames"] for one in found), "wrong:", sum(len(one["wrong"]) for one in found)
    )


if __name__ == "__main__":
    main()
