# SPDX-License-Identifier: Apache-2.0
"""What docs/method.md says of the code is so: files, fields of the configuration and their values."""

import re
from functools import reduce
from pathlib import Path

import pytest

from structgstream.presets import PRESETS, StreamConfig

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "method.md"
FOLDERS = (ROOT, ROOT / "src" / "structgstream", ROOT / "tests" / "parity", ROOT / "tests" / "training")
QUOTED = re.compile(r"`([^`]+)`")

pytestmark = pytest.mark.skipif(not PAGE.is_file(), reason="this working copy has no docs/ folder")


def rows_below(heading: str) -> list[list[str]]:
    """Cells of the lines of the first table below a heading, its head left out."""
    _, _, rest = PAGE.read_text().partition(f"{heading}\n")
    table = re.search(r"(?:^\|.*\n)+", rest, re.MULTILINE)
    assert table, heading
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in table[0].splitlines()[2:]]


def value_of(config: StreamConfig, path: str) -> str:
    """A field by its path, as text."""
    return str(reduce(getattr, path.split("."), config))


def test_every_file_that_is_named_is_there() -> None:
    named = {quoted.split(":")[0] for quoted in QUOTED.findall(PAGE.read_text())}
    files = {name for name in named if re.fullmatch(r"[\w/]+\.(py|cpp|cu)", name)}
    assert len(files) > 20
    missing = [name for name in sorted(files) if not any((folder / name).is_file() for folder in FOLDERS)]
    assert missing == []


def test_open_questions_are_fields_with_the_default_that_is_said() -> None:
    rows = rows_below("### Configuration values")
    assert len(rows) > 10
    for _, fields, default, _ in rows:
        paths = [path for path in QUOTED.findall(fields) if "." in path or path == "normalised_radius"]
        assert paths, fields
        for path in paths:
            found = value_of(PRESETS["paper-n3dv"], path)
            said = QUOTED.findall(default)
            assert not said or said[0] == found, (path, found)


def test_the_first_frame_of_rig_is_as_said() -> None:
    for field, paper, rig, _ in rows_below("## What `rig` changes"):
        path = field.strip("`")
        assert paper.strip("`") == value_of(PRESETS["paper-n3dv"], path), path
        assert rig.strip("`") == value_of(PRESETS["rig"], path), path
