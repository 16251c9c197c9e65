# SPDX-License-Identifier: Apache-2.0
import os

import pytest

from benchmarks.machine import Instant, load_average, machine, others_share
from benchmarks.roofline import Peaks, Work, line, measured_peaks


def test_what_others_take_is_what_this_process_does_not() -> None:
    cores = os.cpu_count() or 1
    before = Instant(wall_seconds=0.0, own_seconds=0.0, busy_seconds=100.0)
    assert others_share(before, Instant(10.0, 4.0, 104.0)) == 0.0
    assert others_share(before, Instant(10.0, 4.0, 104.0 + 5.0 * cores)) == pytest.approx(0.5)
    assert others_share(before, Instant(10.0, 4.0, None)) is None


def test_the_machine_names_itself() -> None:
    assert {"cpu", "cores", "torch", "python", "commit", "instruction_set"} <= set(machine())
    now = Instant.now()
    assert now.busy_seconds is None or now.busy_seconds > 0
    assert load_average() is None or len(load_average() or []) == 3


def test_the_roof_is_the_lower_of_two() -> None:
    peaks = Peaks(operations_per_second=1000.0, bytes_per_second=10.0)
    starved = line(Work(operations=100.0, bytes=10.0), 2.0, peaks)  # 10 operations a byte: at most 100 a second.
    assert starved["share_of_roof"] == pytest.approx(0.5)
    assert starved["share_of_peak_bandwidth"] == pytest.approx(0.5)
    busy = line(Work(operations=2000.0, bytes=1.0), 4.0, peaks)
    assert busy["share_of_roof"] == busy["share_of_peak_operations"] == pytest.approx(0.5)


def test_peaks_are_measured() -> None:
    peaks = measured_peaks(1, quick=True)
    assert peaks.operations_per_second > 1e8
    assert peaks.bytes_per_second > 1e7


def test_counted_operations_grow_with_the_work() -> None:
    pytest.importorskip("structgstream.kernels.cpu_raster")
    from benchmarks import decode, raster, ssim

    small, large = (raster.count(splats=n, width=64, height=48) for n in (200, 400))
    assert large.operations == pytest.approx(2 * small.operations, rel=0.3)
    assert ssim.count(width=40, height=30).operations == 4 * ssim.count(width=20, height=15).operations
    everything, online = (decode.count(anchors=100, trained=trained) for trained in ("all", "online"))
    assert everything.operations > online.operations
