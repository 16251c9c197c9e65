# SPDX-License-Identifier: Apache-2.0
"""What the rows of the state table name exists, and a field is added as CONTRIBUTING.md says."""

import re
import shutil
import subprocess
import sys
from dataclasses import fields
from pathlib import Path
from typing import get_type_hints

from structgstream.scene.state import PARAMETERS, STATE_TABLE
from structgstream.training.frame0.fit import InitialRates
from structgstream.training.online.config import OnlineRates
from structgstream.training.parameters import RoundingConfig

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "src" / "structgstream"


def constants_of(config: type) -> set[str]:
    return {name.lower() for name in get_type_hints(config) if name.isupper()}


def test_rows_name_settings_that_there_are() -> None:
    for keys, config in (
        (
            {p.step for p in PARAMETERS} | {row.init_step for row in STATE_TABLE} - {"own", "sensitivity"},
            RoundingConfig,
        ),
        ({p.online_rate for p in PARAMETERS}, OnlineRates),
        ({p.first_rate for p in PARAMETERS}, InitialRates),
    ):
        named = {field.name for field in fields(config)} | constants_of(config)
        assert keys - {None} <= named, config.__name__
    assert constants_of(OnlineRates) == {p.online_rate for p in PARAMETERS} - {None}
    assert {field.name for field in fields(InitialRates)} == {p.first_rate for p in PARAMETERS} - {None}


def applied(diff: str, root: Path) -> set[str]:
    """Writes into ``root`` what a diff with context, but without line numbers, says; tells the files."""
    files = set()
    for part in re.split(r"^--- ", diff, flags=re.MULTILINE)[1:]:
        name, _, body = part.partition("\n")
        for hunk in body.strip("\n").split("\n@@\n"):
            lines = hunk.removeprefix("@@\n").splitlines()
            before = "".join(line[1:] + "\n" for line in lines if not line.startswith("+"))
            after = "".join(line[1:] + "\n" for line in lines if not line.startswith("-"))
            text = (root / name).read_text()
            assert text.count(before) == 1, f"CONTRIBUTING.md shows what {name} does not have once:\n{before}"
            (root / name).write_text(text.replace(before, after))
        files.add(name)
    return files


def test_a_dynamic_field_is_added_as_contributing_says(tmp_path: Path) -> None:
    """The example's diff makes a field that is trained, rounded, sent by both codecs and read back."""
    unneeded = shutil.ignore_patterns("__pycache__", "clip", "assets", "experiments", "peers", "player")
    shutil.copytree(PACKAGE, tmp_path / "src" / "structgstream", ignore=unneeded)
    text = (ROOT / "CONTRIBUTING.md").read_text()
    (diff,) = re.findall(r"```diff\n(.*?)```", text.split("### A dynamic field")[1].split("\n### ")[0], re.DOTALL)
    assert len(applied(diff, tmp_path)) <= 3
    paths = [str(path) for path in (tmp_path / "src", ROOT, Path(__file__).parent)]
    code = f"import sys; sys.path[:0] = {paths}; import added_field; added_field.check()"
    command = [sys.executable, "-I", "-c", code]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    assert result.stdout.startswith(str(tmp_path))
