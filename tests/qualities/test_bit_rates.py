# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

import pytest

from structgstream.codec.segments.quality_list import QUALITIES, read_list
from structgstream.qualities import MIN_PACKETS, BitRates, Quality, bits_per_second, expected_bits
from tests.support.reports import frame_report

LOW, HIGH = Quality("low", -1.0), Quality("high", 1.0)


def listed(folder: Path) -> dict[str, float]:
    return {one.name: one.bits_per_second for one in read_list(folder) or ()}


def frames(rates: BitRates, first: int, end: int, **sizes: int) -> None:
    for index in range(first, end):
        for name, size in sizes.items():
            rates.add(name, frame_report(index, bytes=size, pts_seconds=index / 10))
        rates.refresh()


def test_a_rate_is_of_media_time_without_the_first_packet() -> None:
    assert bits_per_second([(0.0, 9999), (0.5, 100), (2.0, 100)]) == 800
    assert bits_per_second([(0.0, 9999)]) is None
    assert bits_per_second([(0.0, 9), (1.0, 0)]) == 1.0


def test_measured_rates_replace_the_expected_ones(tmp_path: Path) -> None:
    rates = BitRates(tmp_path, (LOW, HIGH))
    rates.begin(resume=False)
    assert listed(tmp_path) == {"low": expected_bits(LOW), "high": expected_bits(HIGH)}
    frames(rates, 0, MIN_PACKETS, low=100, high=1000)
    assert listed(tmp_path) == {"low": expected_bits(LOW), "high": expected_bits(HIGH)}
    frames(rates, MIN_PACKETS, MIN_PACKETS + 1, low=100, high=1000)
    assert listed(tmp_path) == {"low": 8000, "high": 80000}


def test_the_list_is_written_when_a_rate_has_changed_and_at_the_end(tmp_path: Path) -> None:
    rates = BitRates(tmp_path, (LOW, HIGH))
    rates.begin(resume=False)
    frames(rates, 0, 20, low=100, high=1000)
    before = (tmp_path / QUALITIES).stat().st_ino
    frames(rates, 20, 40, low=101, high=1010)
    assert (tmp_path / QUALITIES).stat().st_ino == before
    rates.refresh(last=True)
    assert listed(tmp_path)["low"] == pytest.approx(8040, abs=10)
    after = (tmp_path / QUALITIES).stat().st_ino
    rates.refresh(last=True)
    assert (tmp_path / QUALITIES).stat().st_ino == after
    assert [path.name for path in tmp_path.iterdir()] == [QUALITIES]


def test_a_resumed_run_begins_with_the_rates_of_before(tmp_path: Path) -> None:
    rates = BitRates(tmp_path, (LOW, HIGH))
    rates.begin(resume=False)
    frames(rates, 0, 20, low=100, high=1000)
    BitRates(tmp_path, (LOW, HIGH)).begin(resume=True)
    assert listed(tmp_path) == {"low": 8000, "high": 80000}
    (tmp_path / QUALITIES).write_text("nothing")
    BitRates(tmp_path, (LOW, HIGH)).begin(resume=True)
    assert listed(tmp_path) == {"low": expected_bits(LOW), "high": expected_bits(HIGH)}
