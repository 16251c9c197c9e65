# SPDX-License-Identifier: Apache-2.0
"""Stamps that share a clock, and those that do not."""

import numpy as np
import pytest

from structgstream.errors import CaptureError
from structgstream.preparation.synchronization.stated_clocks import creation_seconds, timecode, wall_clocks

STAMPS = {"a": np.arange(90) / 25, "b": np.arange(90) / 25}
DROPPED = np.arange(90) * 1001 / 30000


def test_timecode_is_preferred() -> None:
    texts = {
        "a": {"timecode": "01:00:00:00", "creation_time": "2024-05-01T10:00:00.1Z"},
        "b": {"timecode": "01:00:02:05", "creation_time": "2024-05-01T10:00:00.2Z"},
    }
    clocks = wall_clocks(STAMPS, texts)
    assert {clock.kind for clock in clocks.values()} == {"timecode"}
    assert clocks["a"].clock.offset_seconds == 0
    assert clocks["b"].clock.offset_seconds == pytest.approx(2.2)


def test_the_first_frame_has_the_stated_time() -> None:
    stamps = {"a": STAMPS["a"] + 0.04, "b": STAMPS["b"]}
    clocks = wall_clocks(stamps, {name: {"timecode": "01:00:00:00"} for name in stamps})
    assert clocks["a"].clock.offset_seconds == pytest.approx(-0.04)


def test_creation_times_with_fractions() -> None:
    texts = {"a": {"creation_time": "2024-05-01T10:00:01.500000Z"}, "b": {"creation_time": "2024-05-01T10:00:01Z"}}
    clocks = wall_clocks(STAMPS, texts)
    assert clocks["a"].clock.offset_seconds == pytest.approx(0.5)
    assert clocks["a"].sigma_seconds > 0.04


def test_stamps_of_a_transmission_hold_as_they_are() -> None:
    clocks = wall_clocks({"a": STAMPS["a"] + 4000, "b": STAMPS["b"] + 4000.3}, {})
    assert all(clock.clock.offset_seconds == 0 and clock.kind == "stamps" for clock in clocks.values())


@pytest.mark.parametrize(
    "texts",
    [
        {},
        {"a": {"creation_time": "2024-05-01T10:00:01Z"}, "b": {"creation_time": "2024-05-01T10:00:03Z"}},
        {"a": {"timecode": "01:00:00:00"}},
        {"a": {"timecode": "01:00:00:00"}, "b": {"timecode": "01:00:00:99"}},
    ],
)
def test_files_that_count_from_zero_share_no_clock(texts: dict[str, dict[str, str]]) -> None:
    with pytest.raises(CaptureError, match=r"share no clock: that of camera '[ab]' has no timecode.*audio, motion"):
        wall_clocks(STAMPS, texts)


@pytest.mark.parametrize("first", ["a", "b"])
@pytest.mark.parametrize(
    ("before", "after", "stamps", "seconds"),
    [
        ("23:59:58:00", "00:00:01:00", STAMPS["a"], 3.0),
        ("23:59:58;00", "00:00:01;00", DROPPED, 90 * 1001 / 30000),
        ("23:59:58:00", "00:00:01:00", DROPPED, 90 * 1001 / 30000),
    ],
    ids=["25", "29.97 drop", "29.97"],
)
def test_timecode_across_midnight(first: str, before: str, after: str, stamps: np.ndarray, seconds: float) -> None:
    """Camera a begins before midnight, b after it, whichever is listed first."""
    texts = {"a": {"timecode": before}, "b": {"timecode": after}}
    names = ("a", "b") if first == "a" else ("b", "a")
    clocks = wall_clocks(dict.fromkeys(names, stamps), texts)
    assert clocks["a"].clock.offset_seconds == 0
    assert clocks["b"].clock.offset_seconds == pytest.approx(seconds)


def of_day(text: str, stamps: np.ndarray) -> float:
    found = timecode(text, stamps)
    assert found is not None
    return found.seconds


def test_dropped_frames_of_timecode() -> None:
    """Drop-frame timecode of ten minutes is 17982 frames of 1001/30000 s; the first minute skips two numbers."""
    assert of_day("00:10:00;00", DROPPED) == pytest.approx(17982 * 1001 / 30000)
    assert of_day("00:01:00;02", DROPPED) == pytest.approx(1800 * 1001 / 30000)
    assert of_day("00:00:59;29", DROPPED) == pytest.approx(1799 * 1001 / 30000)


@pytest.mark.parametrize("rate", [25, 30, 30000 / 1001, 60000 / 1001])
def test_timecode_counts_at_its_nominal_rate_whatever_rounds_and_shakes_the_stamps(rate: float) -> None:
    """Matroska has milliseconds, of which most at 29.97 frames a second are 33 apart."""
    exact = np.arange(300) / rate
    shaken = exact + np.random.default_rng(0).uniform(-3e-4, 3e-4, 300)
    expected = of_day("10:00:00:00", exact)
    assert expected == pytest.approx(36000 * round(rate) / rate)
    assert of_day("10:00:00:00", exact.round(3)) == pytest.approx(expected)
    assert of_day("10:00:00:00", shaken) == pytest.approx(expected)


def test_other_texts() -> None:
    assert timecode("", STAMPS["a"]) is None
    assert timecode("00:61:00:00", STAMPS["a"]) is None
    assert timecode("24:00:00:00", STAMPS["a"]) is None
    assert creation_seconds("yesterday") is None
    assert creation_seconds("1970-01-01T00:01:00.25") == 60.25
    assert creation_seconds("1970-01-01T01:00:00+01:00") == 0
