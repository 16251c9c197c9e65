# SPDX-License-Identifier: Apache-2.0
"""The quick-start of the README is run as it is printed, with a preset that takes seconds."""

import re
import sys
from pathlib import Path

import pytest

from structgstream.session.presets import PRESETS
from tests.support.small_presets import QUICK

README = Path(__file__).parents[1] / "README.md"
SMALLER = {"frames=12": "frames=2, scale=0.25", "render(11,": "render(1,"}


def test_the_quick_start_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    blocks = re.findall(r"```python\n(.*?)```", README.read_text(), flags=re.DOTALL)
    assert len(blocks) == 1
    code = blocks[0]
    assert re.findall(r"^(?:import|from) .*", code, flags=re.MULTILINE) == ["import structgstream"]
    for printed, small in SMALLER.items():
        assert code.count(printed) == 1, printed
        code = code.replace(printed, small)
    monkeypatch.setitem(PRESETS, "fast", QUICK)
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    exec(compile(code, str(README), "exec"), names)
    said = capsys.readouterr().out
    assert [line.split()[0] for line in said.splitlines()[:2]] == ["0", "1"]
    assert " dB at the camera" in said
    assert getattr(names["picture"], "shape", None) == (60, 80, 3)
    assert {"clip.sgs", "clip.log.jsonl", "clip.html"} <= {entry.name for entry in tmp_path.iterdir()}
    assert "structgstream" in sys.modules
