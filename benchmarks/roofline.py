# SPDX-License-Identifier: Apache-2.0
"""What the machine can do, measured in the same run, and what share of it a kernel reaches.

The roofline model (Williams, Waterman and Patterson, 2009): with I operations a byte, no kernel does more than
``min(peak, I * bandwidth)`` operations a second. Operations are counted, not sampled: each benchmark's counting
function says what it counts and why.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass

import torch


@dataclass(frozen=True)
class Work:
    """What one piece of work costs at least: float operations (a fused multiply-add is two) and bytes moved."""

    operations: float
    bytes: float


@dataclass(frozen=True)
class Peaks:
    """Measured at one number of threads: float32 operations a second, bytes a second (read plus written)."""

    operations_per_second: float
    bytes_per_second: float


def _best_seconds(run: Callable[[], object], repeats: int) -> float:
    run()
    best = float("inf")
    for _ in range(repeats):
        started = time.perf_counter()
        run()
        best = min(best, time.perf_counter() - started)
    return best


def measured_peaks(threads: int, *, quick: bool = False) -> Peaks:
    """Peak float32 rate of torch's matrix product (MKL or oneDNN) and the bandwidth of a copy beyond the caches."""
    torch.set_num_threads(threads)
    side, megabytes, repeats = (256, 8, 2) if quick else (2048, 256, 5)
    a, b, c = torch.randn(side, side), torch.randn(side, side), torch.empty(side, side)
    product = _best_seconds(lambda: torch.mm(a, b, out=c), repeats)
    source = torch.ones(megabytes * 2**18)
    target = torch.empty_like(source)
    copy = _best_seconds(lambda: target.copy_(source), repeats)
    return Peaks(2.0 * side**3 / product, 2.0 * source.numel() * 4 / copy)


def line(work: Work, seconds: float, peaks: Peaks) -> dict[str, float]:
    """Achieved rates, their shares of the peaks, and the share of what the roofline allows at this intensity."""
    achieved = work.operations / seconds
    roof = min(peaks.operations_per_second, work.operations / work.bytes * peaks.bytes_per_second)
    return {
        "operations": work.operations,
        "bytes": work.bytes,
        "operations_per_second": achieved,
        "share_of_peak_operations": achieved / peaks.operations_per_second,
        "share_of_peak_bandwidth": work.bytes / seconds / peaks.bytes_per_second,
        "share_of_roof": achieved / roof,
    }
