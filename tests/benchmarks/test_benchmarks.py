# SPDX-License-Identifier: Apache-2.0
import importlib
import json
from pathlib import Path

import pytest

from benchmarks.__main__ import NAMES, main
from benchmarks.benchmark import Target, judged
from tests.support.backends import needs_native


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    """``python -m benchmarks`` with arguments; gives what it printed."""

    def command(*arguments: str | Path) -> str:
        monkeypatch.setattr("sys.argv", ["benchmarks", *map(str, arguments)])
        main()
        return capsys.readouterr().out

    return command


@needs_native
@pytest.mark.parametrize("name", NAMES)
def test_a_benchmark_checks_times_and_writes_what_it_measured(name: str, tmp_path: Path, run) -> None:
    out, plots = tmp_path / "result.json", tmp_path / "plots"
    growth = ["--growth", "--plots", plots] if name == NAMES[0] else []
    run(name, "--quick", "--repeats", 1, "--json", out, *growth)
    result = json.loads(out.read_text())
    assert {"machine", "load_average", "peaks", "command", "benchmarks"} <= set(result)
    found = result["benchmarks"][name]
    for variant in found["variants"]:
        first, *others = variant["contestants"].values()
        assert first["times_faster"] is None
        assert others
        assert all(entry["times_faster"]["median"] > 0 for entry in others)
        for entry in variant["contestants"].values():
            assert 0 < entry["seconds"]["least"] <= entry["seconds"]["median"] <= entry["seconds"]["most"]
            assert len(entry["rounds_seconds"]) == 1
    assert len(list(plots.glob("*.png"))) == len(found["growth"])
    assert bool(found["growth"]) == bool(growth)
    printed = run("table", out)
    for variant in found["variants"]:
        assert all(f"| {contestant} |" in printed for contestant in variant["contestants"])
    targets = {target.contestant for target in importlib.import_module(f"benchmarks.{name}").BENCHMARK.targets}
    assert targets <= {contestant for variant in found["variants"] for contestant in variant["contestants"]}
    for growth in found["growth"]:
        assert f"growth over {growth['axis']}" in printed


def test_a_target_is_reported_with_what_was_got() -> None:
    entry = {"seconds": {"median": 0.05}, "times_faster": {"median": 2.5}}
    missed, met = judged(Target("ours", at_least_times=3.0), entry), judged(Target("ours", at_most_seconds=0.06), entry)
    assert (missed["got"], missed["met"]) == (2.5, False)
    assert (met["got"], met["met"]) == (0.05, True)


def test_an_unknown_name_is_refused(run, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        run("nonsense")
    assert "no benchmark nonsense" in capsys.readouterr().err
