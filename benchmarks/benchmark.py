# SPDX-License-Identifier: Apache-2.0
"""A benchmark is a value: its contestants at some size, what is checked, what it must reach, how its size doubles."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from benchmarks.contest import TURN_SECONDS, Contestant, Quantity, Results, check, ratios, spread, timed
from benchmarks.machine import Instant, others_share
from benchmarks.roofline import Peaks, Work, line

Sizes = Mapping[str, Any]
"""Keyword arguments of ``contestants``."""
PICTURES = ((240, 180), (340, 255), (480, 360), (680, 510), (960, 720))
"""Widths and heights of which each has twice the pixels of the one before."""


@dataclass(frozen=True)
class Variant:
    """One contest of a benchmark: what it is called, and its sizes (``quick``: for a trial in seconds)."""

    title: str
    full: Sizes
    quick: Sizes


@dataclass(frozen=True)
class Growth:
    """Sizes that double along one axis.

    Args:
        axis: what grows, with its unit.
        full: the sizes, as arguments of ``contestants``, by the number that stands on the axis.
        quick: the same for a trial.
        only: names of the contestants that run, where others would take too long; all when empty.
    """

    axis: str
    full: Mapping[float, Sizes]
    quick: Mapping[float, Sizes]
    only: Sequence[str] = ()


@dataclass(frozen=True)
class Target:
    """What a contestant must reach in the full contest: times the first contestant's speed, or seconds."""

    contestant: str
    at_least_times: float | None = None
    at_most_seconds: float | None = None


@dataclass(frozen=True)
class Benchmark:
    """Everything that the command line needs.

    Args:
        name: on the command line.
        work: what one timed piece of work is, in words.
        contestants: builds the contest from sizes; its first contestant is what ratios refer to.
        quantities: what is compared before timing.
        variants: the contests of a run without ``--growth``.
        growth: the curves of a run with it.
        targets: what it must reach.
        oracle: the true results at the same sizes, in float64; None compares with the first contestant.
        count: operations and bytes of one piece of work from the same sizes; None where they are not counted.
        per_second: how the pieces of work done in a second are called, where that number is worth telling.
    """

    name: str
    work: str
    contestants: Callable[..., list[Contestant]]
    quantities: Sequence[Quantity]
    variants: Sequence[Variant]
    growth: Sequence[Growth] = ()
    targets: Sequence[Target] = ()
    oracle: Callable[..., Results] | None = None
    count: Callable[..., Work] | None = None
    per_second: str | None = None


def run_variant(
    benchmark: Benchmark, variant: Variant, *, quick: bool, repeats: int, peaks: Mapping[int, Peaks]
) -> dict[str, Any]:
    """One contest, checked and timed, as plain JSON values; ``peaks`` by number of threads (empty: no roofline)."""
    sizes = variant.quick if quick else variant.full
    entries = benchmark.contestants(**sizes)
    errors = check(entries, benchmark.quantities, oracle=benchmark.oracle(**sizes) if benchmark.oracle else None)
    before = Instant.now()
    seconds = timed(entries, repeats=repeats, turn_seconds=0.0 if quick else TURN_SECONDS)
    busy = others_share(before, Instant.now())
    factors = ratios(seconds)
    title = f"quick, {', '.join(f'{key} {value}' for key, value in sizes.items())}" if quick else variant.title
    found: dict[str, Any] = {"title": title, "sizes": dict(sizes), "others_share": busy, "contestants": {}}
    work = benchmark.count(**sizes) if benchmark.count is not None and peaks else None
    for entry in entries:
        summary = spread(seconds[entry.name])
        found["contestants"][entry.name] = {
            "threads": entry.threads,
            "seconds": summary,
            "rounds_seconds": seconds[entry.name],
            "times_faster": factors.get(entry.name),
            "errors": errors.get(entry.name, {}),
            "facts": dict(entry.facts()),
            "per_second": 1.0 / summary["median"] if benchmark.per_second else None,
            "roofline": line(work, summary["median"], peaks[entry.threads])
            if work and entry.threads in peaks
            else None,
        }
    if not quick:
        found["targets"] = [
            judged(t, found["contestants"][t.contestant]) for t in benchmark.targets if t.contestant in seconds
        ]
    return found


def judged(target: Target, entry: Mapping[str, Any]) -> dict[str, Any]:
    """A target and what was measured."""
    asked = {name: value for name, value in vars(target).items() if value is not None}
    if target.at_least_times is not None:
        got = entry["times_faster"]["median"]
        return asked | {"got": got, "met": got >= target.at_least_times}
    assert target.at_most_seconds is not None
    got = entry["seconds"]["median"]
    return asked | {"got": got, "met": got <= target.at_most_seconds}
