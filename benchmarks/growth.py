# SPDX-License-Identifier: Apache-2.0
"""How seconds grow with size: sizes that double, the slope on log-log axes, a plot of each curve."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.benchmark import Benchmark, Growth
from benchmarks.contest import TURN_SECONDS, check, spread, timed
from benchmarks.machine import Instant, others_share
from structgstream.figure import figure_of, save_figure


def slope(sizes: Sequence[float], seconds: Sequence[float]) -> float:
    """Least-squares slope of log seconds over log size: 1 is linear, 0 does not depend on the size."""
    return float(np.polyfit(np.log(sizes), np.log(seconds), 1)[0])


def run_growth(benchmark: Benchmark, growth: Growth, *, quick: bool, repeats: int) -> dict[str, Any]:
    """One curve, every size checked before it is timed, as plain JSON values."""
    sizes = growth.quick if quick else growth.full
    curves: dict[str, list[dict[str, Any]]] = {}
    before = Instant.now()
    for size, arguments in sizes.items():
        entries = benchmark.contestants(**arguments)
        entries = [entry for entry in entries if not growth.only or entry.name in growth.only]
        check(entries, benchmark.quantities, oracle=benchmark.oracle(**arguments) if benchmark.oracle else None)
        seconds = timed(entries, repeats=repeats, turn_seconds=0.0 if quick else TURN_SECONDS)
        for entry in entries:
            point = {"size": size, "seconds": spread(seconds[entry.name]), "facts": dict(entry.facts())}
            curves.setdefault(entry.name, []).append(point)
    return {
        "axis": growth.axis,
        "others_share": others_share(before, Instant.now()),
        "curves": curves,
        "slopes": {
            name: slope([point["size"] for point in points], [point["seconds"]["median"] for point in points])
            for name, points in curves.items()
        },
    }


def plot(title: str, found: Mapping[str, Any], path: Path) -> None:
    """Draw one curve of :func:`run_growth` with its spread, log-log, the slope in the legend."""
    figure = figure_of(6.0, 4.0)
    axes = figure.subplots()
    for name, points in found["curves"].items():
        sizes = [point["size"] for point in points]
        median = [1e3 * point["seconds"]["median"] for point in points]
        below = [1e3 * (point["seconds"]["median"] - point["seconds"]["least"]) for point in points]
        above = [1e3 * (point["seconds"]["most"] - point["seconds"]["median"]) for point in points]
        axes.errorbar(
            sizes,
            median,
            yerr=[below, above],
            marker="o",
            capsize=3,
            label=f"{name}: slope {found['slopes'][name]:.2f}",
        )
    axes.set(xscale="log", yscale="log", xlabel=found["axis"], ylabel="milliseconds", title=title)
    sizes = [point["size"] for point in next(iter(found["curves"].values()))]
    axes.set_xticks(sizes, labels=[f"{size:,.6g}" for size in sizes])
    axes.set_xticks([], minor=True)
    axes.grid(visible=True, which="both", alpha=0.3)
    axes.legend(fontsize="small")
    save_figure(figure, path)
