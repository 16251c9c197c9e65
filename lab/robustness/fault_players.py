# SPDX-License-Identifier: Apache-2.0
"""Players of ``load_players`` that another process watches while they play.

``python -m lab.robustness.fault_players ADDRESS COUNT`` prints the least number of frames that any of them has whenever
it has changed, and at the end of the stream what each got, as JSON.
"""

import argparse
import asyncio
import json
import os
import subprocess
import sys
import time
from dataclasses import asdict

from lab.robustness.load_players import Got, follow

EVERY_SECONDS = 0.02


class Players:
    """Players in a process of their own, until the end of the block.

    Args:
        address: of the stream, with a slash at its end.
        count: of players.
    """

    def __init__(self, address: str, count: int) -> None:
        self._command = [sys.executable, "-m", "lab.robustness.fault_players", address, str(count)]
        self._least, self._rest = 0, b""
        self._found: list[Got] | None = None

    def __enter__(self) -> "Players":
        self._running = subprocess.Popen(self._command, stdout=subprocess.PIPE)
        assert self._running.stdout is not None
        os.set_blocking(self._running.stdout.fileno(), False)
        return self

    def __exit__(self, *raised: object) -> None:
        self._running.kill()
        self._running.communicate()

    def least_frames(self) -> int:
        """How many frames the last of them has, from the first on."""
        self._read()
        return self._least

    def ended(self, seconds: float) -> list[Got]:
        """What each got, once the stream has ended.

        Raises:
            TimeoutError: they do not come to the end.
        """
        last = time.monotonic() + seconds
        while self._found is None:
            self._read()
            if time.monotonic() > last:
                raise TimeoutError(f"players have not come to the end within {seconds:g} s")
            time.sleep(EVERY_SECONDS)
        return self._found

    def _read(self) -> None:
        assert self._running.poll() in (None, 0), "the players fail"
        assert self._running.stdout is not None
        try:
            while data := os.read(self._running.stdout.fileno(), 1 << 16):
                self._rest += data
        except BlockingIOError:
            pass
        *lines, self._rest = self._rest.split(b"\n")
        for line in lines:
            found = json.loads(line)
            if isinstance(found, int):
                self._least = found
            else:
                self._found = [Got(**one) for one in found]


async def play(address: str, count: int) -> None:
    """Plays to the end of the stream."""
    all_got = [Got() for _ in range(count)]
    playing = [asyncio.create_task(follow(address, one, slow=False)) for one in all_got]
    told = -1
    while not all(task.done() for task in playing):
        for task in playing:
            if task.done():
                task.result()  # raises what ended it
        least = min(one.frames for one in all_got)
        if least != told:
            told = least
            print(told, flush=True)
        await asyncio.sleep(EVERY_SECONDS)
    await asyncio.gather(*playing)
    print(json.dumps([asdict(one) for one in all_got]), flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("address")
    parser.add_argument("count", type=int)
    options = parser.parse_args()
    asyncio.run(play(options.address, options.count))
