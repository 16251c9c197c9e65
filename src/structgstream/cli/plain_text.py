# SPDX-License-Identifier: Apache-2.0
"""Sentences of commands: as they are, in full."""

from rich.console import Console


def printable(text: str) -> str:
    """A text with what a terminal would obey, or cannot show, as escapes, such as ``\\x1b``."""
    return "".join(one if one.isprintable() or one in "\n\t" else ascii(one)[1:-1] for one in text)


def say(console: Console, *lines: str) -> None:
    """Prints lines without what rich makes of tables: no colours of numbers, no markup, since names of files may have
    brackets, and no breaks at the width of the terminal, so that paths can be copied and programs can read them.
    """
    for line in lines:
        console.print(printable(line), highlight=False, markup=False, soft_wrap=True)
