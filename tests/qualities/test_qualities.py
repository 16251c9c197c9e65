# SPDX-License-Identifier: Apache-2.0
"""What several qualities are, what they share, and what is said of them."""

import math
from dataclasses import replace
from pathlib import Path

import pytest

from structgstream.codec.segments.quality_list import QUALITIES, read_list
from structgstream.errors import ConfigError
from structgstream.evaluation.run_log import log_entry
from structgstream.qualities import (
    MIN_PACKETS,
    BitRates,
    Once,
    Quality,
    bits_per_second,
    configured,
    expected_bits,
    joint_entry,
    joint_report,
    qualities_in,
)
from structgstream.session.presets import PRESETS
from tests.support.reports import frame_report


def test_the_coarsest_comes_first() -> None:
    assert qualities_in(["high=1", "low=-1.5", "mid=0"]) == (
        Quality("low", -1.5),
        Quality("mid", 0),
        Quality("high", 1),
    )


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (["low=1"], "2 to 8 qualities, .* got 1; for a single one give --quality"),
        ([f"q{n}={n / 4}" for n in range(9)], "2 to 8 qualities, .* got 9"),
        (["low", "high=1"], "low is no quality; expected NAME=Q"),
        (["low=x", "high=1"], "low=x is no quality"),
        (["low=1=2", "high=1"], "low=1=2 is no quality"),
        (["=1", "high=1"], "=1 is no quality"),
        (["a.b=1", "high=2"], "a.b=1 is no quality"),
        (["low=-7", "high=1"], "a Q from -6 to 6"),
        (["low=nan", "high=1"], "low=nan is no quality"),
        (["low=1", "low=2"], "has the name low twice"),
        (["low=1", "Low=2"], "has the name low twice"),
        (["low=1", "high=1.0"], "has the Q 1 twice"),
    ],
)
def test_what_is_no_ladder_is_refused(given: list[str], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        qualities_in(given)


def test_a_quality_is_the_knob_and_nothing_else() -> None:
    config = PRESETS["tiny"]
    found = configured(config, Quality("low", -1.5))
    assert found.online.rounding.quality == -1.5
    rounding = replace(found.online.rounding, quality=config.online.rounding.quality)
    assert replace(found, online=replace(found.online, rounding=rounding)) == config
    with pytest.raises(ConfigError, match="got the codec raw; add --preset compact"):
        configured(PRESETS["rig"], Quality("low", -1.5))


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


def test_bytes_and_seconds_are_sums() -> None:
    low = frame_report(3, bytes=100, seconds={"read": 1.0, "fit": 2.0, "total": 3.0}, absent=("b",), cpu_seconds=2.0)
    high = frame_report(3, bytes=400, seconds={"fit": 4.0, "total": 5.0}, absent=("b",), cpu_seconds=4.0)
    joint = joint_report({"low": low, "high": high})
    assert (joint.index, joint.bytes, joint.cpu_seconds, joint.absent) == (3, 500, 6.0, ("b",))
    assert joint.seconds == {"read": 1.0, "fit": 6.0, "total": 8.0}
    assert math.isnan(joint.train_psnr)
    entry = joint_entry(joint, {"low": log_entry(low), "high": log_entry(high)})
    assert (entry["index"], entry["bytes"], entry["total_seconds"], entry["absent"]) == (3, 500, 8.0, ["b"])
    assert entry["qualities"]["low"] == {
        "kind": "delta",
        "bytes": 100,
        "train_psnr": 20.0,
        "total_seconds": 3.0,
        "cpu_seconds": 2.0,
        "anchors": 1,
        "free": 0,
    }


def test_who_asks_first_makes_it() -> None:
    once, made = Once[str](2), []

    def make(text: str) -> str:
        made.append(text)
        return text

    assert once.value(1, lambda: make("a")) == ("a", True)
    assert once.value(1, lambda: make("b")) == ("a", False)
    once.value(2, lambda: make("c"))
    once.value(3, lambda: make("d"))
    assert once.value(1, lambda: make("e")) == ("e", True), "only so many are kept"
    once.clear()
    assert once.value(3, lambda: make("f")) == ("f", True)
    assert made == ["a", "c", "d", "e", "f"]
