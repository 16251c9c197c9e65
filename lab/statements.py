# SPDX-License-Identifier: Apache-2.0
"""Draws statements of the documents to check by hand: ``python -m lab.statements [--seed 0] [--count 30]``.

A statement is a sentence or a row of a table of README.md or docs/*.md that has a digit or the name of some code.
"""

import argparse
import random
import re
from collections.abc import Iterator, Sequence
from pathlib import Path


def statements(text: str) -> Iterator[tuple[int, str]]:
    """The statements of a document in Markdown, each with its line; code blocks, headings and rules are left out."""
    inside = False
    for number, line in enumerate(text.splitlines(), start=1):
        inside ^= line.lstrip().startswith("```")
        if inside or line.lstrip().startswith(("```", "#", "![", "|-", "| -")):
            continue
        parts = [line] if line.startswith("|") else re.split(r"(?<=[.:;]) +(?=[A-Z`*\"])", line)
        yield from ((number, part.strip()) for part in parts if re.search(r"\d|`", part) and len(part.split()) > 5)


def main(arguments: Sequence[str] | None = None) -> None:
    """Prints the drawn statements with file and line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--count", type=int, default=30)
    options = parser.parse_args(arguments)
    pages = [Path("README.md"), *sorted(Path("docs").glob("*.md"))]
    found = [(page, *statement) for page in pages for statement in statements(page.read_text())]
    for page, line, words in random.Random(options.seed).sample(found, min(options.count, len(found))):
        print(f"{page}:{line}: {words}")


if __name__ == "__main__":
    main()
