# SPDX-License-Identifier: Apache-2.0
"""Tables of times and stamps that share a clock, and what may be wrong with them."""

from pathlib import Path

import numpy as np
import pytest

from structgstream.errors import CaptureError
from structgstream.preparation.synchronization.stated_clocks import (
    creation_seconds,
    read_timestamps,
    timecode,
    wall_clocks,
)

STAMPS = {"left": np.arange(90) / 30, "right": np.arange(150) / 50}


def table(folder: Path, rows: str, header: str = "camera,frame,seconds") -> Path:
    file = folder / "timestamps.csv"
    file.write_text(f"{header}\n{rows}\n")
    return file


def test_one_row_a_camera_gives_the_offset(tmp_path: Path) -> None:
    clocks = read_timestamps(table(tmp_path, "left,60,0\nright,25,0.0"), STAMPS)
    assert clocks["left"].clock.offset_seconds == pytest.approx(-2.0)
    assert clocks["right"].clock.offset_seconds == pytest.approx(-0.5)
    assert clocks["right"].clock.rate == 1


def test_all_rows_give_offset_rate_and_spread(tmp_path: Path) -> None:
    generator = np.random.default_rng(0)
    rows = [f"left,{k},{100 + 1.001 * k / 30 + generator.normal(0, 1e-4):.6f}" for k in range(90)]
    rows += [f"right,{k},{100 + k / 50:.6f}" for k in range(150)]
    clocks = read_timestamps(table(tmp_path, "\n".join(rows)), STAMPS)
    assert clocks["left"].clock.rate == pytest.approx(1.001, abs=1e-4)
    assert clocks["left"].clock.offset_seconds == pytest.approx(100, abs=1e-3)
    assert clocks["left"].sigma_seconds == pytest.approx(1e-4, rel=0.5)
    assert clocks["right"].clock.rate == 1


@pytest.mark.parametrize(("rows", "rate"), [
    ("right,0,12.03\nright,149,15.02", 1.0),
    ("right,0,12\nright,149,14.99", 1.0),
    ("right,0,12.000\nright,5,12.101", 1.0),
    ("right,0,12.000\nright,149,15.000", 1.0067),
])  # fmt: skip
def test_what_rounding_explains_is_no_drift(tmp_path: Path, rows: str, rate: float) -> None:
    found = read_timestamps(table(tmp_path, f"left,0,12\n{rows}"), STAMPS)
    assert found["right"].clock.rate == pytest.approx(rate, abs=1e-3)
    assert (found["right"].clock.rate == 1.0) == (rate == 1.0)


@pytest.mark.parametrize(
    "content",
    [
        "\ufeffcamera, frame, seconds\nleft, 0, 1\nright, 0, 2.25\n".encode(),
        "camera;frame;seconds\r\nleft;0;1,5\r\nright;0;2,25\r\n".encode("utf-16"),
    ],
    ids=["spaces and a byte order mark", "a spreadsheet with decimal commas"],
)
def test_what_other_programs_write_is_read(tmp_path: Path, content: bytes) -> None:
    file = tmp_path / "timestamps.csv"
    file.write_bytes(content)
    assert read_timestamps(file, STAMPS)["right"].clock.offset_seconds == 2.25


@pytest.mark.parametrize(
    ("rows", "header", "message"),
    [
        ("left,0,0", None, r"no row for camera 'right'; it has cameras 'left'"),
        ("left,0,0\nright,150,0", None, r"frame 150 of camera 'right', whose frames are 0 to 149"),
        ("left,-1,0\nright,0,0", None, r"frame -1 of camera 'left'"),
        ("left,0,0\nright,0,soon", None, r"Line 3 of .* is not a camera, a frame number and seconds"),
        ("left,0,nan\nright,0,0", None, r"Line 2"),
        ("left,0,0,\nright,0,12,034", None, r"Line 3 of .* has more cells .* decimal points, or semicolons"),
        ("left,0,0\nleft,0,1\nright,0,0", None, r"two times for frame 0 of camera 'left'"),
        ("left,0", "camera,frame", r"lacks the column 'seconds'"),
        ("left,0,0\nleft,89,1.5\nright,0,0", None, r"runs 0.5056 times as fast"),
        ("left,0,0\nleft,40,1.4\nleft,89,2.9667\nright,0,0", None, r"frame 40 of camera 'left' is .* off a steady"),
    ],
)
def test_mistakes_are_named(tmp_path: Path, rows: str, header: str | None, message: str) -> None:
    file = table(tmp_path, rows, header) if header else table(tmp_path, rows)
    with pytest.raises(CaptureError, match=message):
        read_timestamps(file, STAMPS)


def test_a_missing_table(tmp_path: Path) -> None:
    with pytest.raises(CaptureError, match=r"timestamps.csv cannot be read \(No such file"):
        read_timestamps(tmp_path / "timestamps.csv", STAMPS)


BOTH = {"a": np.arange(90) / 25, "b": np.arange(90) / 25}
DROPPED = np.arange(90) * 1001 / 30000


def test_timecode_is_preferred() -> None:
    texts = {
        "a": {"timecode": "01:00:00:00", "creation_time": "2024-05-01T10:00:00.1Z"},
        "b": {"timecode": "01:00:02:05", "creation_time": "2024-05-01T10:00:00.2Z"},
    }
    clocks = wall_clocks(BOTH, texts)
    assert {clock.kind for clock in clocks.values()} == {"timecode"}
    assert clocks["a"].clock.offset_seconds == 0
    assert clocks["b"].clock.offset_seconds == pytest.approx(2.2)


def test_the_first_frame_has_the_stated_time() -> None:
    stamps = {"a": BOTH["a"] + 0.04, "b": BOTH["b"]}
    clocks = wall_clocks(stamps, {name: {"timecode": "01:00:00:00"} for name in stamps})
    assert clocks["a"].clock.offset_seconds == pytest.approx(-0.04)


def test_creation_times_with_fractions() -> None:
    texts = {"a": {"creation_time": "2024-05-01T10:00:01.500000Z"}, "b": {"creation_time": "2024-05-01T10:00:01Z"}}
    clocks = wall_clocks(BOTH, texts)
    assert clocks["a"].clock.offset_seconds == pytest.approx(0.5)
    assert clocks["a"].sigma_seconds > 0.04


def test_stamps_of_a_transmission_hold_as_they_are() -> None:
    clocks = wall_clocks({"a": BOTH["a"] + 4000, "b": BOTH["b"] + 4000.3}, {})
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
        wall_clocks(BOTH, texts)


@pytest.mark.parametrize("first", ["a", "b"])
@pytest.mark.parametrize(
    ("before", "after", "stamps", "seconds"),
    [
        ("23:59:58:00", "00:00:01:00", BOTH["a"], 3.0),
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
    assert timecode("", BOTH["a"]) is None
    assert timecode("00:61:00:00", BOTH["a"]) is None
    assert timecode("24:00:00:00", BOTH["a"]) is None
    assert creation_seconds("yesterday") is None
    assert creation_seconds("1970-01-01T00:01:00.25") == 60.25
    assert creation_seconds("1970-01-01T01:00:00+01:00") == 0
