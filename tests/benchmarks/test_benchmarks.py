# SPDX-License-Identifier: Apache-2.0
import json
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from structgstream.kernels._load import native_reason

ROOT = Path(__file__).parents[2]


@pytest.mark.skipif(native_reason() is not None, reason=str(native_reason()))
def test_the_raster_benchmark_checks_times_and_writes_json(tmp_path: Path) -> None:
    out = tmp_path / "raster.json"
    options = ["--splats", "500", "--size", "64", "48", "--repeats", "2", "--json", str(out)]
    subprocess.run([sys.executable, "-m", "benchmarks", "raster", *options], cwd=ROOT, check=True, capture_output=True)
    result = json.loads(out.read_text())
    assert set(result) == {"ratios", "contestants", "environment"}
    assert set(result["ratios"]) == {"cpu, 1 thread", "cpu, 2 threads"}
    assert all(times["min"] <= times["median"] <= times["max"] for times in result["contestants"].values())


def test_a_wrong_contestant_is_not_timed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(ROOT)
    from benchmarks.contest import Contestant, check

    right = Contestant("right", lambda: [torch.ones(5)], 1)
    wrong = Contestant("wrong", lambda: [torch.full((5,), 1.1)], 1)
    check([right, right], tolerance=1e-4)
    with pytest.raises(SystemExit, match="wrong differs from right"):
        check([right, wrong], tolerance=1e-4)
