# SPDX-License-Identifier: Apache-2.0
"""``structgstream board``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro
from rich.console import Console

from structgstream.cli.app import usage_errors
from structgstream.cli.options import check_ending, parse_options
from structgstream.cli.progress import print_lines


@dataclass(frozen=True)
class BoardCommand:
    """Writes a calibration board to print: a ChArUco board in its exact size, as PDF.

    Print it at 100 %, check the bar on it with a ruler, glue it to something flat, and show it slowly to all cameras,
    so that each sees it large and neighbours see it together. Then: structgstream prepare VIDEOS -o CAPTURE
    --calibration board.

    Example: structgstream board -o board.pdf

    Example: structgstream board -o board.pdf --paper A2 --square 80mm
    """

    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="OUT.pdf")]
    """The file to write."""
    paper: Literal["A4", "A3", "A2", "A1", "A0", "letter", "tabloid"] = "A3"
    """The page."""
    squares: Annotated[str, tyro.conf.arg(metavar="COLUMNSxROWS")] = "7x5"
    """Squares across and down."""
    square: Annotated[str, tyro.conf.arg(metavar="LENGTH")] = "50mm"
    """Side of a square."""
    dictionary: Annotated[str, tyro.conf.arg(metavar="NAME")] = "DICT_5X5_100"
    """Markers: one of OpenCV's predefined dictionaries."""


def main(arguments: list[str]) -> None:
    """Writes the board and says how to name it to prepare."""
    options = parse_options(BoardCommand, "board", arguments=arguments)
    check_ending(options.output, ".pdf", command="board")
    from structgstream.preparation.calibration.board import write_board_pdf
    from structgstream.preparation.options import board_text, parse_board

    with usage_errors():
        board = parse_board(f"{options.squares}:{options.square}:{options.dictionary}")
        write_board_pdf(options.output, board, options.paper)
    console = Console()
    written = (
        f"Wrote {options.output}: {board.text}, on {options.paper}. Print it at 100 %, and check its bar with a ruler."
    )
    print_lines(console, written)
    use = f"Then: structgstream prepare VIDEOS -o CAPTURE --calibration board --board {board_text(board)}"
    print_lines(console, use)
