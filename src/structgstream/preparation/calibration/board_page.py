# SPDX-License-Identifier: Apache-2.0
"""A ChArUco board as a page to print, in its exact size."""

from collections.abc import Iterator
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any, Literal

import numpy as np

from structgstream.atomic_files import atomic_write
from structgstream.data.images import opencv
from structgstream.errors import ConfigError, MissingExtraError
from structgstream.preparation.calibration.board import Board

Paper = Literal["A4", "A3", "A2", "A1", "A0", "letter", "tabloid"]

PAPERS_MM: dict[Paper, tuple[float, float]] = {
    "A4": (297.0, 210.0),
    "A3": (420.0, 297.0),
    "A2": (594.0, 420.0),
    "A1": (841.0, 594.0),
    "A0": (1189.0, 841.0),
    "letter": (279.4, 215.9),
    "tabloid": (431.8, 279.4),
}
"""Width and height, lying."""

MM_PER_INCH = 25.4
MARGIN_MM = 6.0
FOOT_MM = 14.0
BAR_MM = 100.0
OVERLAP = 1e-4  # of a square, between rows of a marker, so that no hairline shows there


@dataclass(frozen=True)
class Rectangle:
    """A black rectangle of the page: left, bottom, width and height in mm from the page's lower left corner."""

    left: float
    bottom: float
    width: float
    height: float


def write_board_pdf(path: Path, board: Board, paper: Paper = "A4") -> None:
    """A page with ``board`` as vectors in its exact size, a bar of known length to check the print, and its text.

    Raises:
        ConfigError: the board does not fit the paper.
        MissingExtraError: matplotlib or cv2 is not installed.
        StorageError: the file cannot be written.
    """
    width, height = board_page(board, paper)
    figure, canvas = _figure(width, height)
    for cell in (*board_rectangles(board, paper), *_bar(board, paper)):
        figure.add_artist(_drawn(cell, width, height))
    figure.text((MARGIN_MM + BAR_MM + 6) / width, (MARGIN_MM + 4.5) / height, board.text, fontsize=8, va="bottom")
    figure.text(
        (MARGIN_MM + BAR_MM + 6) / width,
        MARGIN_MM / height,
        f"Print at 100 %, without fitting to the page: the bar is {BAR_MM:g} mm long. Glue it to something flat.",
        fontsize=6.5,
        va="bottom",
    )
    content = BytesIO()
    canvas.print_pdf(content, metadata={"CreationDate": None, "Title": f"ChArUco board, {board.text}"})
    atomic_write(path, content.getvalue(), called="The board", new_folder=True)


def board_page(board: Board, paper: Paper) -> tuple[float, float]:
    """Width and height of the page in mm, lying.

    Raises:
        ConfigError: an unknown paper, or one that is too small.
    """
    if paper not in PAPERS_MM:
        raise ConfigError(f"{paper!r} is no paper size; expected one of {', '.join(PAPERS_MM)}.")
    width, height = PAPERS_MM[paper]
    across, down = (1000 * side for side in board.size_metres)
    room = width - 2 * MARGIN_MM, height - 2 * MARGIN_MM - FOOT_MM
    if across > room[0] + 1e-9 or down > room[1] + 1e-9:
        fitting = 1000 * board.square_metres * min(room[0] / across, room[1] / down)
        raise ConfigError(
            f"A board of {across:g} x {down:g} mm does not fit {paper}, which has room for {room[0]:g} x {room[1]:g} "
            f"mm; take squares of {np.floor(fitting):g} mm or less, or larger paper."
        )
    return width, height


def board_rectangles(board: Board, paper: Paper) -> tuple[Rectangle, ...]:
    """The black parts of the board on the page: squares, and the cells of markers row by row."""
    width, height = board_page(board, paper)
    side = 1000 * board.square_metres
    left = (width - board.columns * side) / 2
    top = height - MARGIN_MM - (height - 2 * MARGIN_MM - FOOT_MM - board.rows * side) / 2
    cells = [*_squares(board), *_markers(board)]
    return tuple(
        Rectangle(left + x * side, top - (y + down) * side, across * side, down * side) for x, y, across, down in cells
    )


def _squares(board: Board) -> Iterator[tuple[float, float, float, float]]:
    """Black squares as left, top, width and height in squares: those without a marker."""
    marked = {(int(x), int(y)) for x, y in _marker_corners(board)}
    for row in range(board.rows):
        for column in range(board.columns):
            if (column, row) not in marked:
                yield column, row, 1.0, 1.0


def _markers(board: Board) -> Iterator[tuple[float, float, float, float]]:
    """Runs of black cells of the markers."""
    cv2 = opencv()
    layout = board.opencv_board()
    dictionary = layout.getDictionary()
    cells = dictionary.markerSize + 2
    for number, (x, y) in zip(np.ravel(layout.getIds()), _marker_corners(board), strict=True):
        black = cv2.aruco.generateImageMarker(dictionary, int(number), cells) < 128
        step = board.marker_share / cells
        for row in range(cells):
            edges = np.flatnonzero(np.diff(np.concatenate([[False], black[row], [False]]).astype(int)))
            for start, end in edges.reshape(-1, 2):
                yield (
                    x + start * step,
                    y + row * step,
                    (end - start) * step,
                    step + (OVERLAP if row + 1 < cells else 0.0),
                )


def _marker_corners(board: Board) -> list[tuple[float, float]]:
    """Top-left corners of the markers, in squares."""
    found = [np.asarray(corners)[0, :2] / board.square_metres for corners in board.opencv_board().getObjPoints()]
    return [(float(x), float(y)) for x, y in found]


def _bar(board: Board, paper: Paper) -> Iterator[Rectangle]:
    """A bar with a tick at each centimetre."""
    yield Rectangle(MARGIN_MM, MARGIN_MM, BAR_MM, 0.4)
    for step in range(11):
        tall = 4.0 if step % 5 == 0 else 2.5
        wide = 0.3
        left = MARGIN_MM + step * BAR_MM / 10 - wide / 2
        left = min(max(left, MARGIN_MM), MARGIN_MM + BAR_MM - wide)  # the bar's ends are those of its end ticks
        yield Rectangle(left, MARGIN_MM, wide, tall)


def _figure(width: float, height: float) -> tuple[Any, Any]:
    try:
        from matplotlib.backends.backend_pdf import FigureCanvasPdf
        from matplotlib.figure import Figure
    except ImportError:
        raise MissingExtraError("matplotlib", "report") from None
    figure = Figure(figsize=(width / MM_PER_INCH, height / MM_PER_INCH))
    return figure, FigureCanvasPdf(figure)


def _drawn(cell: Rectangle, width: float, height: float) -> Any:
    from matplotlib.patches import Rectangle as Patch

    return Patch(
        (cell.left / width, cell.bottom / height), cell.width / width, cell.height / height, color="black", linewidth=0
    )
