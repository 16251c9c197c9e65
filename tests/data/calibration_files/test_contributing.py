# SPDX-License-Identifier: Apache-2.0
"""The worked example of CONTRIBUTING.md, "A capture format", is a converter that works."""

import csv
import re
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from structgstream.data.calibration import CalibrationFormat, PosedCamera, intrinsics, rigid
from structgstream.data.lenses import from_integer_centers
from structgstream.data.text_files import number, read_text
from structgstream.data.text_files import pixels as picture_pixels
from structgstream.errors import CalibrationError
from tests.support.calibrations import POINTS, pixels, truths
from tests.support.captures import HEIGHT, WIDTH

ROOT = Path(__file__).parents[3]


@pytest.fixture
def rig_csv() -> CalibrationFormat:
    section = (ROOT / "CONTRIBUTING.md").read_text().split("### A capture format")[1].split("\n##")[0]
    (code,) = re.findall(r" *```python\n(.*?)```", section, re.DOTALL)
    known: dict[str, Any] = {
        "csv": csv, "Any": Any, "Iterator": Iterator, "Path": Path, "CalibrationFormat": CalibrationFormat,
        "PosedCamera": PosedCamera, "intrinsics": intrinsics, "rigid": rigid, "read_text": read_text, "number": number,
        "from_integer_centers": from_integer_centers, "pixels": picture_pixels,
    }  # fmt: skip
    exec(compile(textwrap.dedent(code), "CONTRIBUTING.md", "exec"), known)
    return known["RIG_CSV"]


def test_the_example_reads_what_it_says(rig_csv: CalibrationFormat, tmp_path: Path) -> None:
    assert [*rig_csv.find(tmp_path)] == []
    cameras = truths(dist=(0, 0, 0, 0))
    rows = ["name,width,height,fx,fy,cx,cy,rx,ry,rz,tx,ty,tz"]
    for camera in cameras:
        K = camera.K
        numbers = [K[0, 0], K[1, 1], K[0, 2], K[1, 2], *camera.rvec, *camera.T]
        rows.append(f"{camera.name},{WIDTH},{HEIGHT},{','.join(repr(float(number)) for number in numbers)}")
    (tmp_path / "rig.csv").write_text("\n".join(rows))
    (files,) = rig_csv.find(tmp_path)
    found = rig_csv.read(files)
    for truth, camera in zip(cameras, found.cameras, strict=True):
        np.testing.assert_allclose(pixels(camera, POINTS), truth.pixels(POINTS), atol=1e-7)
    (tmp_path / "rig.csv").write_text("\n".join(rows).replace("rvec", "r").replace("fx", "focal"))
    with pytest.raises(
        CalibrationError, match=r"'cam00' of .*rig\.csv cannot be read \(no 'fx'\); expected a row per cam"
    ):
        rig_csv.read(files)


def test_the_files_it_names_exist_or_are_its_own() -> None:
    """At most three."""
    section = (ROOT / "CONTRIBUTING.md").read_text().split("### A capture format")[1].split("\n##")[0]
    steps = re.findall(r"^\d\. `([^`]+)`", section, re.MULTILINE)
    assert len(steps) == 3
    assert [(ROOT / path).is_file() for path in steps] == [False, True, True]
