# SPDX-License-Identifier: Apache-2.0
"""Sentences of commands: as they are, in full."""

from rich.console import Console


def say(console: Console, *lines: str) -> None:
    """Prints lines without what rich makes of tables: no colours of numbers, no markup, since names of files may have
    brackets, and no breaks at the width of the terminal, so that paths can be copied and programs can read them.
    """
    for line in lines:
        console.print(line, highlight=False, markup=False, soft_wrap=True)
