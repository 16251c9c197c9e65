# SPDX-License-Identifier: Apache-2.0
"""What commands say arrives as it is."""

import io

from rich.console import Console

from structgstream.cli.plain_text import say


def test_names_with_brackets_and_long_paths_stay_as_they_are() -> None:
    written = io.StringIO()
    path = "take [red] 2/" + "folder/" * 40 + "out.sgs"
    say(Console(file=written, width=40, force_terminal=True), f"Wrote {path}: 12.5 MB", "and more")
    assert written.getvalue() == f"Wrote {path}: 12.5 MB\nand more\n"
