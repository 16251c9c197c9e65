# SPDX-License-Identifier: Apache-2.0
"""Contestants on the same work: checked, then timed in turns.

``python -m benchmarks [NAME ...]`` runs; ``python -m benchmarks table FILE`` prints a JSON result as Markdown.
"""

import argparse
import importlib
import json
import os
import re
import sys
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # Read once, when torch loads OpenMP.

NAMES = (
    "raster",
    "ssim",
    "decode",
    "adam",
    "planes",
    "entropy",
    "compact",
    "iteration",
    "frame0",
    "online",
    "render",
)


def parsed(arguments: list[str] | None = None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(NAMES)}; all when none is named")
    parser.add_argument("--repeats", type=int, default=5, help="rounds, each with one run of every contestant")
    parser.add_argument("--growth", action="store_true", help="also time sizes that double")
    parser.add_argument("--quick", action="store_true", help="tiny sizes: a trial of the benchmarks, numbers of no use")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write everything that was measured")
    parser.add_argument("--plots", type=Path, metavar="FOLDER", help="with --growth: write a plot of each curve here")
    options = parser.parse_args(arguments)
    unknown = [name for name in options.names if name not in NAMES]
    if unknown:
        parser.error(f"there is no benchmark {', '.join(unknown)}; choose from {', '.join(NAMES)}")
    if options.plots and not options.growth:
        parser.error("--plots draws growth curves; add --growth")
    return options


def measured(options: argparse.Namespace) -> dict[str, Any]:
    """Run the chosen benchmarks and report each result when it is there."""
    from benchmarks.benchmark import Benchmark, run_variant
    from benchmarks.growth import plot, run_growth
    from benchmarks.machine import load_average, machine
    from benchmarks.report import environment_lines, growth_lines, variant_lines
    from benchmarks.roofline import measured_peaks

    names = options.names or NAMES
    benchmarks: list[Benchmark] = [importlib.import_module(f"benchmarks.{name}").BENCHMARK for name in names]
    before = load_average()
    counted = any(benchmark.count for benchmark in benchmarks)
    peaks = {threads: measured_peaks(threads, quick=options.quick) for threads in (1, 2)} if counted else {}
    results: dict[str, Any] = {}
    for benchmark in benchmarks:
        found: dict[str, Any] = {"name": benchmark.name, "work": benchmark.work, "per_second": benchmark.per_second}
        found |= {"variants": [], "growth": []}
        results[benchmark.name] = found
        for variant in benchmark.variants:
            outcome = run_variant(benchmark, variant, quick=options.quick, repeats=options.repeats, peaks=peaks)
            found["variants"].append(outcome)
            print(*variant_lines(found, outcome), sep="\n", flush=True)
        for growth in benchmark.growth if options.growth else ():
            outcome = run_growth(benchmark, growth, quick=options.quick, repeats=options.repeats)
            found["growth"].append(outcome)
            print(*growth_lines(found, outcome), sep="\n", flush=True)
            if options.plots:
                axis = re.sub(r"\W+", "_", growth.axis.split(" (")[0])
                plot(benchmark.work, outcome, options.plots / f"{benchmark.name}_{axis}.png")
    result = {
        "command": " ".join(["python -m benchmarks", *sys.argv[1:]]),
        "repeats": options.repeats,
        "quick": options.quick,
        "machine": machine(),
        "load_average": {"before": before, "after": load_average()},
        "peaks": {str(threads): vars(peak) for threads, peak in peaks.items()},
        "benchmarks": results,
    }
    print(*environment_lines(result), sep="\n")
    return result


def main() -> None:
    """Run benchmarks, or print a result as Markdown."""
    if sys.argv[1:2] == ["table"]:
        from benchmarks.report import print_tables, table

        print_tables(sys.argv[2:], table)
        return
    options = parsed()
    result = measured(options)
    if options.json:
        options.json.write_text(json.dumps(result, indent=2) + "\n")


if __name__ == "__main__":
    main()
