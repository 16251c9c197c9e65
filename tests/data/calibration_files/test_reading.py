# SPDX-License-Identifier: Apache-2.0
"""Broken files become one sentence that names file, camera and remedy."""

import json
from pathlib import Path

import numpy as np
import pytest

from structgstream.data.calibration import PosedCamera, calibration_of
from structgstream.data.calibration_files import reading
from structgstream.data.calibration_files.reading import json_files_with
from structgstream.data.text_files import Unreadable, readable, reason
from structgstream.errors import CalibrationError

FILE = Path("rig.json")


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (KeyError("fx"), "no 'fx'"),
        (ValueError("odd"), "values are missing, or of another form"),
        (TypeError("odd"), "values are missing, or of another form"),
        (IndexError("odd"), "values are missing, or of another form"),
        (Unreadable("odd"), "odd"),
        (PermissionError(13, "Permission denied", "rig.json"), "Permission denied"),
        (OSError("odd"), "values are missing, or of another form"),
    ],
)
def test_what_was_wrong_in_a_clause(error: Exception, said: str) -> None:
    assert reason(error) == said
    with pytest.raises(CalibrationError) as found, readable(FILE, "fx and fy"):
        raise error
    assert str(found.value) == f"rig.json cannot be read ({said}); expected fx and fy."


def test_what_is_reported_already_is_not_reported_again() -> None:
    with pytest.raises(CalibrationError, match="^as it is$"), readable(FILE, "more"):
        raise CalibrationError("as it is")
    with pytest.raises(AssertionError), readable(FILE, "more"):
        raise AssertionError  # a mistake of ours


def camera(name: str, entry: dict) -> PosedCamera:
    if entry.get("own"):
        raise CalibrationError("its own sentence")
    return PosedCamera(name, np.eye(4), np.eye(3) * entry["fx"], None)


def test_a_broken_entry_names_its_camera() -> None:
    found = calibration_of([("a", {"fx": 1}), ("b", {"fx": 2})], camera, file=FILE, expected="fx")
    assert [one.name for one in found.cameras] == ["a", "b"]
    with pytest.raises(CalibrationError, match=r"^Camera 'b' of rig\.json cannot be read \(no 'fx'\); expected fx\.$"):
        calibration_of([("a", {"fx": 1}), ("b", {})], camera, file=FILE, expected="fx")
    with pytest.raises(CalibrationError, match="^its own sentence$"):
        calibration_of([("b", {"own": True})], camera, file=FILE, expected="fx")
    with pytest.raises(CalibrationError, match=r"^rig\.json holds no cameras; expected fx\.$"):
        calibration_of([], camera, file=FILE, expected="fx")


def test_the_first_file_with_a_key(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert [*json_files_with(tmp_path, "cams")] == []
    (tmp_path / "a.json").write_text('{"cameras": "cams"')
    (tmp_path / "b.txt").write_text('{"cams": 1}')
    (tmp_path / "c.json").write_text(json.dumps({"cams": 1}))
    (tmp_path / "d.json").write_text(json.dumps({"cams": 1}))
    assert next(json_files_with(tmp_path, "cams")) == (tmp_path / "a.json",)
    (tmp_path / "a.json").unlink()
    assert next(json_files_with(tmp_path, "cams")) == (tmp_path / "c.json",)
    monkeypatch.setattr(reading, "LARGEST_BYTES", 5)
    assert [*json_files_with(tmp_path, "cams")] == []
