# SPDX-License-Identifier: Apache-2.0
"""The machine and its load, for whoever reads the numbers later."""

import os
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from structgstream.evaluation.environment import environment
from structgstream.kernels.native import instruction_set, native_reason


def machine() -> dict[str, Any]:
    """Processor, cores, instruction set of the kernels, versions and commit."""
    return {**environment(), "instruction_set": None if native_reason() else instruction_set()}


@dataclass(frozen=True)
class Instant:
    """Wall-clock, this process's and the machine's busy seconds (None where the system does not report it)."""

    wall_seconds: float
    own_seconds: float
    busy_seconds: float | None

    @classmethod
    def now(cls) -> "Instant":
        """This instant."""
        return cls(time.perf_counter(), time.process_time(), _busy_seconds())


def _busy_seconds() -> float | None:
    """Processor seconds of all processes since the start, summed over cores (Linux)."""
    stat = Path("/proc/stat")
    if not stat.exists():
        return None
    user, nice, system, _, _, interrupts, soft_interrupts, stolen, *_ = map(
        int, stat.read_text().splitlines()[0].split()[1:]
    )
    return (user + nice + system + interrupts + soft_interrupts + stolen) / os.sysconf("SC_CLK_TCK")


def others_share(before: Instant, after: Instant) -> float | None:
    """Share of the machine (0 to 1) that other processes took between two instants: how quiet it was."""
    if before.busy_seconds is None or after.busy_seconds is None:
        return None
    others = after.busy_seconds - before.busy_seconds - (after.own_seconds - before.own_seconds)
    share = others / ((after.wall_seconds - before.wall_seconds) * (os.cpu_count() or 1))
    return min(max(share, 0.0), 1.0)  # The system counts in hundredths of a second.


def load_average() -> list[float] | None:
    """Mean number of running processes over 1, 5 and 15 minutes; None where the system does not report it."""
    return [round(value, 2) for value in os.getloadavg()] if hasattr(os, "getloadavg") else None
