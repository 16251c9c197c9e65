# SPDX-License-Identifier: Apache-2.0
import json
import re
from dataclasses import replace
from pathlib import Path

import pytest

from structgstream.errors import StorageError
from structgstream.preparation.checking.check import check_capture
from structgstream.preparation.report import write_report
from tests.support.drawn import pixels_of
from tests.support.memory_captures import MemoryCapture
from tests.support.planes import room_frame, room_rig


def test_the_page_shows_everything_and_loads_nothing(tmp_path: Path) -> None:
    rig = room_rig(5)
    checked = check_capture(MemoryCapture(rig, [room_frame(rig)], name="<room>"))
    report = replace(checked.report, steps={"scale": "metres"})
    page = write_report(tmp_path / "report", replace(checked, report=report)).read_text()
    assert "&lt;room&gt;" in page
    assert "http" not in page
    pictures = re.findall(r"<img src='([^']+)'", page)
    assert {f"camera_{name}.png" for name in rig} <= set(pictures)
    assert {"pairs.png", "coverage.png", "colors.png"} <= set(pictures)
    for name in pictures:
        assert pixels_of(tmp_path / "report" / name).std() > 5
    numbers = json.loads((tmp_path / "report" / "report.json").read_text())
    assert set(numbers["cameras"]) == set(rig)
    assert numbers["steps"] == {"scale": "metres"}
    assert numbers["median_epipolar_pixels"] == report.median_epipolar_pixels


def test_an_earlier_report_goes_and_nothing_else(tmp_path: Path) -> None:
    (tmp_path / "camera_old.png").write_text("")
    (tmp_path / "notes.txt").write_text("")
    rig = room_rig(4)
    write_report(tmp_path, check_capture(MemoryCapture(rig, [room_frame(rig, textured=False)])))
    assert (tmp_path / "notes.txt").is_file()
    assert not (tmp_path / "camera_old.png").exists()


def test_no_room_is_reported(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    rig = room_rig(4)
    checked = check_capture(MemoryCapture(rig, [room_frame(rig, textured=False)]))
    with pytest.raises(StorageError, match="cannot be written"):
        write_report(tmp_path / "file", checked)
