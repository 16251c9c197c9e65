# SPDX-License-Identifier: Apache-2.0
"""The script for a machine with a GPU, with the cpu back-end in the GPU's place."""

import json
from pathlib import Path

import pytest

from benchmarks.gpu import Measurement, measured
from structgstream.kernels.backend import cpu_backend
from tests.support.backends import needs_native

pytestmark = needs_native


def test_parts_are_measured_and_one_that_fails_ends_none(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def fails() -> dict[str, object]:
        raise ValueError("no such thing")

    sizes = {"tiny": {"anchors": 120, "width": 48, "height": 32, "cameras": 3}}
    measurement = Measurement(cpu_backend(), sizes, lambda: None)
    names = ("rasteriser", "correctness", "iterations", "pictures", "frames")
    parts = {"fails": fails, **{name: getattr(measurement, name) for name in names}}
    out = tmp_path / "out.json"
    found = measured(parts, out, until=float("inf"))
    assert json.loads(out.read_text()).keys() == parts.keys()
    assert {name: part["failed"] for name, part in found.items() if "failed" in part} == {
        "fails": "ValueError: no such thing"
    }
    assert found["correctness"]["tiny"]["gradient error"] == 0.0
    assert found["correctness"]["tiny"]["equal bits"]
    assert found["rasteriser"]["tiny"]["gradient error"] == 0.0
    assert found["rasteriser"]["tiny"]["equal bits"]
    assert "(predicted: " in capsys.readouterr().out
    assert "skipped" in measured(parts, out, until=0.0)["pictures"]
