# SPDX-License-Identifier: Apache-2.0
"""Checks contestants against each other, times them in turns, and reports their ratios."""

import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

Results = Sequence[Tensor | None]
"""What is compared, quantity by quantity; None where a contestant does not compute one."""


@dataclass(frozen=True)
class Contestant:
    """One way to do the work.

    Args:
        name: how tables call it.
        run: does the work once and returns what is checked.
        threads: how many it may use.
        units: pieces of work in one run, such as iterations; seconds are reported per piece.
        facts: other numbers about it, computed once after timing (quality, shares of stages).
    """

    name: str
    run: Callable[[], Results]
    threads: int
    units: int = 1
    facts: Callable[[], Mapping[str, float]] = dict


@dataclass(frozen=True)
class Quantity:
    """What is compared before timing, in the order in which contestants return it.

    ``median`` is the median over elements of the relative error, ``norm`` the norm of the difference over the norm,
    ``largest`` the largest absolute difference. The median suits results in which a coin toss of rounding (two splats
    of one depth) changes a few elements a lot.
    """

    name: str
    tolerance: float
    measure: Literal["median", "norm", "largest"] = "norm"

    def error(self, ours: Tensor, theirs: Tensor) -> float:
        """How far ``ours`` is from ``theirs``; infinite when their shapes differ."""
        if ours.shape != theirs.shape:
            return float("inf")
        if ours.numel() == 0:
            return 0.0
        a, b = ours.detach().double(), theirs.detach().double()
        if self.measure == "largest":
            return float((a - b).abs().max())
        if self.measure == "median":
            return float(((a - b).abs() / (b.abs() + 1e-6)).median())
        return float((a - b).norm() / b.norm().clamp_min(1e-30))


def check(
    contestants: Sequence[Contestant], quantities: Sequence[Quantity], *, oracle: Results | None = None
) -> dict[str, dict[str, float]]:
    """Errors of every contestant against the oracle or, without one, the first contestant; each runs once.

    Raises:
        SystemExit: one exceeds its tolerance, and nothing is timed.
    """
    truth, against = oracle, "the oracle"
    errors: dict[str, dict[str, float]] = {}
    for contestant in contestants:
        torch.set_num_threads(contestant.threads)
        results = contestant.run()
        if truth is None:
            truth, against = results, contestant.name
            continue
        found: dict[str, float] = {}
        for quantity, ours, theirs in zip(quantities, results, truth, strict=True):
            if ours is None or theirs is None:
                continue
            found[quantity.name] = error = quantity.error(ours, theirs)
            if not error <= quantity.tolerance:
                raise SystemExit(
                    f"{contestant.name} differs from {against} in {quantity.name}: {quantity.measure} error "
                    f"{error:.2g}, allowed {quantity.tolerance:.2g}. Nothing was timed."
                )
        errors[contestant.name] = found
    return errors


TURN_SECONDS = 0.1


def timed(
    contestants: Sequence[Contestant], *, repeats: int, turn_seconds: float = TURN_SECONDS
) -> dict[str, list[float]]:
    """Seconds for one piece of work of each contestant, one value a round.

    Contestants take turns and every round starts with another one, so that load from outside meets all. A turn runs
    again until ``turn_seconds`` have passed and gives the mean: a kernel of a millisecond is met as in training, with
    its threads awake, and not as the first thing after another contestant's.
    """
    seconds: dict[str, list[float]] = {contestant.name: [] for contestant in contestants}
    for round_number in range(repeats):
        first = round_number % len(contestants)
        for contestant in (*contestants[first:], *contestants[:first]):
            torch.set_num_threads(contestant.threads)
            started, elapsed, runs = time.perf_counter(), 0.0, 0
            while runs == 0 or elapsed < turn_seconds:
                contestant.run()
                runs += 1
                elapsed = time.perf_counter() - started
            seconds[contestant.name].append(elapsed / (runs * contestant.units))
    return seconds


def spread(values: Sequence[float]) -> dict[str, float]:
    """Median, least and most."""
    return {"median": statistics.median(values), "least": min(values), "most": max(values)}


def ratios(seconds: Mapping[str, Sequence[float]]) -> dict[str, dict[str, float]]:
    """How many times faster each contestant is than the first: spread of the ratios within each round."""
    names = list(seconds)
    slow = seconds[names[0]]
    return {name: spread([s / f for s, f in zip(slow, seconds[name], strict=True)]) for name in names[1:]}
