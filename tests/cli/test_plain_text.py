# SPDX-License-Identifier: Apache-2.0
"""What commands say arrives as it is."""

import io

import pytest
from rich.console import Console

from structgstream.cli.progress import literal_cells, print_lines, printable


def test_names_with_brackets_and_long_paths_stay_as_they_are() -> None:
    written = io.StringIO()
    path = "take [red] 2/" + "folder/" * 40 + "out.sgs"
    print_lines(Console(file=written, width=40, force_terminal=True), f"Wrote {path}: 12.5 MB", "and more")
    assert written.getvalue() == f"Wrote {path}: 12.5 MB\nand more\n"


def test_what_a_terminal_would_obey_is_shown_as_escapes(capsys: pytest.CaptureFixture[str]) -> None:
    assert printable("caf\u00e9 \u4e2d\n\tend") == "caf\u00e9 \u4e2d\n\tend"
    assert printable("a\x1b]0;mine\x07\ud800\u202e") == r"a\x1b]0;mine\x07\ud800\u202e"
    print_lines(Console(), "name \x1b[31m \ud800")
    assert capsys.readouterr().out == "name \\x1b[31m \\ud800\n"
    assert [cell.plain for cell in literal_cells("\x1b[2J")] == [r"\x1b[2J"]
