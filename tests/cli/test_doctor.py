# SPDX-License-Identifier: Apache-2.0
"""Doctor says what is there, what is not, and what mends it."""

import importlib.metadata
import json
from pathlib import Path

import pytest

from structgstream.cli import doctor, main
from structgstream.kernels import backend


def test_everything_is_listed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor", "--json", str(tmp_path / "d.json")]) == 0
    found = json.loads((tmp_path / "d.json").read_text())
    assert [entry["name"] for entry in found["backends"]] == ["cuda", "cpu", "reference"]
    assert sum(entry["state"].startswith("chosen") for entry in found["backends"]) == 1
    names = {"av", "cv2", "scipy", "yaml", "matplotlib", "starlette", "uvicorn", "s3fs", "anywidget"}
    names |= {"prometheus_client", "pxr", "fourdgs", "PIL", "pycolmap", "ray"}
    assert {entry["name"] for entry in found["packages"]} == names
    text = capsys.readouterr().out
    assert "reference" in text
    assert "cores" in text
    for entry in found["packages"]:
        assert entry["version"] or f"structgstream[{entry['extra']}]" in text


def test_what_is_missing_comes_with_its_cure(monkeypatch: pytest.MonkeyPatch) -> None:
    reasons = {"cuda": "No GPU here.", "cpu": None, "reference": None}
    monkeypatch.setattr(backend, "backend_reasons", lambda: reasons)
    monkeypatch.setattr(doctor.importlib.util, "find_spec", lambda name: None)
    found = doctor.diagnose()
    assert [entry["state"] for entry in found["backends"]] == ["missing", "chosen by --device auto", "available"]
    assert found["backends"][0]["advice"] == "No GPU here."
    advice = {entry["name"]: entry["advice"] for entry in found["packages"]}
    assert "pip install 'structgstream[capture]'" in advice["av"]
    assert "pip install 'structgstream[report]'" in advice["matplotlib"]


def test_a_package_that_was_copied_has_no_version(monkeypatch: pytest.MonkeyPatch) -> None:
    found, missing = doctor.diagnose(), importlib.metadata.PackageNotFoundError
    there = {entry["name"] for entry in found["packages"] if entry["version"]}

    def no_metadata(name: str) -> str:
        raise missing(name)

    monkeypatch.setattr(importlib.metadata, "version", no_metadata)
    versions = {entry["name"]: entry["version"] for entry in doctor.diagnose()["packages"]}
    assert there
    assert versions == {name: "without a version" if name in there else None for name in versions}
