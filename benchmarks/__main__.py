# SPDX-License-Identifier: Apache-2.0
"""``python -m benchmarks NAME``: see ``--help``."""

import argparse
import json
import os
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # Read once, when torch loads OpenMP.


def main() -> None:
    """Run one benchmark and print its table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("name", choices=["raster"])
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--splats", type=int, default=60_000)
    parser.add_argument("--size", type=int, nargs=2, default=(480, 360), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()

    from benchmarks import raster
    from benchmarks.contest import check, environment, ratios, timed

    width, height = options.size
    entries = raster.contestants(splats=options.splats, width=width, height=height)
    check(entries, tolerance=1e-4)  # Float32 against float32; measured medians are under 1e-5.
    times = timed(entries, repeats=options.repeats)
    factors = ratios(times)
    print(f"{options.name}, forward and backward: {options.splats} splats, {width}x{height}, {options.repeats} rounds")
    for name, seconds in times.items():
        milliseconds = "  ".join(f"{key} {1e3 * value:8.1f} ms" for key, value in seconds.items())
        factor = factors.get(name)
        spread = f"   {factor['median']:.0f}x ({factor['least']:.0f} to {factor['most']:.0f})" if factor else ""
        print(f"{name:<28}{milliseconds}{spread}")
    if options.json:
        result = {"ratios": factors, "contestants": times, "environment": environment()}
        options.json.write_text(json.dumps(result, indent=2) + "\n")


if __name__ == "__main__":
    main()
