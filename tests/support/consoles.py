# SPDX-License-Identifier: Apache-2.0
"""Consoles of rich in memory."""

import io

from rich.console import Console


def console(*, terminal: bool = False, width: int = 150, height: int = 30) -> Console:
    return Console(file=io.StringIO(), force_terminal=terminal, width=width, height=height, color_system=None)


def text(of: Console) -> str:
    assert isinstance(of.file, io.StringIO)
    return of.file.getvalue()
