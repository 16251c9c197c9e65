# SPDX-License-Identifier: Apache-2.0
import json
import subprocess
import sys
from pathlib import Path

import pytest

from structgstream.kernels._load import native_reason

ROOT = Path(__file__).parents[2]
NAMES = ["raster", "ssim", "decode", "adam"]


@pytest.mark.skipif(native_reason() is not None, reason=str(native_reason()))
@pytest.mark.parametrize("name", NAMES)
def test_a_benchmark_checks_times_and_writes_what_it_measured(name: str, tmp_path: Path) -> None:
    out, plots = tmp_path / "result.json", tmp_path / "plots"
    options = ["--quick", "--repeats", "2", "--growth", "--json", str(out), "--plots", str(plots)]
    subprocess.run([sys.executable, "-m", "benchmarks", name, *options], cwd=ROOT, check=True, capture_output=True)
    result = json.loads(out.read_text())
    assert {"machine", "load_average", "peaks", "command", "benchmarks"} <= set(result)
    found = result["benchmarks"][name]
    for variant in found["variants"]:
        first, *others = variant["contestants"].values()
        assert first["times_faster"] is None
        assert all(entry["times_faster"]["median"] > 0 for entry in others)
        for entry in variant["contestants"].values():
            assert 0 < entry["seconds"]["least"] <= entry["seconds"]["median"] <= entry["seconds"]["most"]
            assert len(entry["rounds_seconds"]) == 2
    assert len(list(plots.glob("*.png"))) == len(found["growth"])
    printed = subprocess.run(
        [sys.executable, "-m", "benchmarks", "table", str(out)], cwd=ROOT, check=True, capture_output=True, text=True
    ).stdout
    for variant in found["variants"]:
        assert all(f"| {contestant} |" in printed for contestant in variant["contestants"])
    for growth in found["growth"]:
        assert f"growth over {growth['axis']}" in printed


def test_an_unknown_name_is_refused() -> None:
    command = [sys.executable, "-m", "benchmarks", "nonsense"]
    result = subprocess.run(command, cwd=ROOT, check=False, capture_output=True, text=True)
    assert result.returncode == 2
    assert "no benchmark nonsense" in result.stderr
