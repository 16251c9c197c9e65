# SPDX-License-Identifier: Apache-2.0
"""Tables of times, and what may be wrong with them."""

from pathlib import Path

import numpy as np
import pytest

from structgstream.errors import CaptureError
from structgstream.preparation.synchronization.stated_clocks import read_timestamps

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


def test_spaces_and_a_byte_order_mark_are_read(tmp_path: Path) -> None:
    file = tmp_path / "timestamps.csv"
    file.write_text("\ufeffcamera, frame, seconds\nleft, 0, 1\nright, 0, 2\n", encoding="utf-8")
    assert read_timestamps(file, STAMPS)["right"].clock.offset_seconds == 2


def test_a_spreadsheet_with_decimal_commas(tmp_path: Path) -> None:
    file = tmp_path / "timestamps.csv"
    file.write_bytes("camera;frame;seconds\r\nleft;0;1,5\r\nright;0;2,25\r\n".encode("utf-16"))
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
