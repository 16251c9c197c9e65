# SPDX-License-Identifier: Apache-2.0
"""Checks contestants against each other, times them in turns, and tells their ratios."""

import os
import platform
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor


@dataclass(frozen=True)
class Contestant:
    """A name, what it runs, and how many threads it may use; ``run`` returns what is checked."""

    name: str
    run: Callable[[], list[Tensor]]
    threads: int


def check(contestants: list[Contestant], *, tolerance: float) -> None:
    """Every result is close to the first contestant's: the median relative error stays under ``tolerance``.

    Raises:
        SystemExit: one is not, and nothing is timed.
    """
    truth = contestants[0].run()
    for contestant in contestants[1:]:
        torch.set_num_threads(contestant.threads)
        for ours, theirs in zip(contestant.run(), truth, strict=True):
            error = ((ours.double() - theirs.double()).abs() / (theirs.double().abs() + 1e-6)).median().item()
            if not error < tolerance:
                raise SystemExit(f"{contestant.name} differs from {contestants[0].name}: median error {error:.2g}.")


def timed(contestants: list[Contestant], *, repeats: int) -> dict[str, dict[str, float]]:
    """Minimum, median and maximum seconds of each, the runs of all taking turns."""
    seconds: dict[str, list[float]] = {contestant.name: [] for contestant in contestants}
    for _ in range(repeats):
        for contestant in contestants:
            torch.set_num_threads(contestant.threads)
            started = time.perf_counter()
            contestant.run()
            seconds[contestant.name].append(time.perf_counter() - started)
    return {
        name: {"min": min(values), "median": statistics.median(values), "max": max(values)}
        for name, values in seconds.items()
    }


def ratios(times: dict[str, dict[str, float]]) -> dict[str, dict[str, float]]:
    """How many times faster each is than the first: of medians, and the least and most that the spread allows."""
    slow = times[next(iter(times))]
    return {
        name: {
            "median": slow["median"] / fast["median"],
            "least": slow["min"] / fast["max"],
            "most": slow["max"] / fast["min"],
        }
        for name, fast in list(times.items())[1:]
    }


def environment() -> dict[str, Any]:
    """The machine, for whoever reads the numbers later."""
    from structgstream.kernels._load import instruction_set

    model = platform.processor()
    if os.path.exists("/proc/cpuinfo"):
        with open("/proc/cpuinfo") as file:
            model = next((line.split(":", 1)[1].strip() for line in file if line.startswith("model name")), model)
    return {
        "cpu": model,
        "cores": os.cpu_count(),
        "instruction_set": instruction_set(),
        "torch": torch.__version__,
        "python": platform.python_version(),
    }
