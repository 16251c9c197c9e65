# SPDX-License-Identifier: Apache-2.0
"""Nobody but the state table keeps a list of fields, and what its rows name exists."""

import ast
import re
import shutil
import subprocess
import sys
from dataclasses import fields
from pathlib import Path

from structgstream.config_fields import constants_of
from structgstream.scene.state import PARAMETERS, STATE_TABLE
from structgstream.training.frame0.fit import InitialRates
from structgstream.training.online.config import OnlineRates
from structgstream.training.parameters import RoundingConfig

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "src" / "structgstream"
NAMES = {row.name for row in STATE_TABLE} | {parameter.name for parameter in PARAMETERS}
LISTS_ELSEWHERE = {
    "session/presets.py": "what a preset adds to the paper's dynamic set is that preset's choice",
    "cli/stream_tables.py": "short titles of two columns, so that a line has 80 characters",
}


def listed(tree: ast.AST) -> list[tuple[int, list[str]]]:
    """Line and names of every tuple, list, set or dict that is written with two names of the table or more."""
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Tuple | ast.List | ast.Set | ast.Dict):
            parts = [*node.keys, *node.values] if isinstance(node, ast.Dict) else node.elts
            names = [part.value for part in parts if isinstance(part, ast.Constant) and part.value in NAMES]
            if len(names) > 1:
                found.append((node.lineno, names))
    return found


def test_a_list_is_noticed() -> None:
    assert listed(ast.parse('x = 1\nROWS = {"anchor_positions": 0, "other": "offset_scales"}')) == [
        (2, ["anchor_positions", "offset_scales"])
    ]
    assert not listed(ast.parse('x = ("free", "anchors")'))


def test_the_table_is_the_only_list_of_fields() -> None:
    found = {str(path.relative_to(PACKAGE)): listed(ast.parse(path.read_text())) for path in PACKAGE.rglob("*.py")}
    places = {path for path, lists in found.items() if lists} - {"scene/state.py"}
    assert places == LISTS_ELSEWHERE.keys(), {path: found[path] for path in places - LISTS_ELSEWHERE.keys()}


def test_rows_name_settings_that_there_are() -> None:
    for keys, config in (
        (
            {p.step for p in PARAMETERS} | {row.init_step for row in STATE_TABLE} - {"own", "sensitivity"},
            RoundingConfig,
        ),
        ({p.online_rate for p in PARAMETERS}, OnlineRates),
        ({p.first_rate for p in PARAMETERS}, InitialRates),
    ):
        named = {field.name for field in fields(config)} | constants_of(config).keys()
        assert keys - {None} <= named, config.__name__
    assert constants_of(OnlineRates).keys() == {p.online_rate for p in PARAMETERS} - {None}
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
