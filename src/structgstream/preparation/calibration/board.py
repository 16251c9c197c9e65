# SPDX-License-Identifier: Apache-2.0
"""A ChArUco board: where cameras see it, and a page to print in its exact size.

A chessboard whose white squares hold markers (Garrido-Jurado et al., Pattern Recognition 2014)."""

import os
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from structgstream.atomic_files import atomic_write
from structgstream.data.images import opencv
from structgstream.errors import CalibrationError, ConfigError, import_extra
from structgstream.geometry import Floats, Indices


@dataclass(frozen=True)
class Board:
    """What is printed.

    Raises:
        ConfigError: sizes that make no board, or an unknown dictionary.
    """

    columns: int = 7  # squares across
    rows: int = 5  # squares down
    square_metres: float = 0.05  # side of a square
    marker_share: float = 0.75  # side of a marker, of a square's
    dictionary: str = "DICT_5X5_100"  # name of one of OpenCV's predefined dictionaries

    def __post_init__(self) -> None:
        if self.columns < 3 or self.rows < 3 or not self.square_metres > 0 or not 0.3 <= self.marker_share <= 0.9:
            raise ConfigError(
                f"A board of {self.columns} x {self.rows} squares of {1000 * self.square_metres:g} mm with markers of "
                f"{self.marker_share:g} of that cannot be made; it needs 3 x 3 squares or more, of positive size, and "
                "a marker share of 0.3 to 0.9."
            )
        if self.columns == self.rows:
            raise ConfigError(
                f"A board of {self.columns} x {self.rows} squares looks alike when turned; take unequal numbers, "
                f"such as {self.columns} x {self.rows - 1 if self.rows > 3 else self.rows + 1}."
            )

    @property
    def corners(self) -> Floats:
        """The inner corners of the chessboard ``[(columns - 1) (rows - 1), 3]`` in metres, z = 0, row by row."""
        across, down = np.meshgrid(np.arange(1.0, self.columns), np.arange(1.0, self.rows))
        flat = np.stack([across.ravel(), down.ravel(), np.zeros(across.size)], 1)
        return np.asarray(flat * self.square_metres, np.float64)

    @property
    def size_metres(self) -> tuple[float, float]:
        """Width and height."""
        return self.columns * self.square_metres, self.rows * self.square_metres

    @property
    def text(self) -> str:
        """One line with all that is needed to use the print."""
        return (
            f"{self.columns} x {self.rows} squares of {1000 * self.square_metres:g} mm, "
            f"markers {1000 * self.square_metres * self.marker_share:g} mm, {self.dictionary}"
        )

    def opencv_board(self, *, marker_first: bool = False) -> Any:
        """The board as OpenCV's; with ``marker_first`` as OpenCV before 4.6 and calib.io print it, where an even number
        of rows begins with a marker in place of a black square. Corners are the same."""
        aruco = opencv().aruco
        number = getattr(aruco, self.dictionary, None)
        if not self.dictionary.startswith("DICT_") or not isinstance(number, int):
            raise ConfigError(
                f"{self.dictionary!r} is no dictionary of OpenCV's; expected such as {', '.join(dictionaries()[:3])}."
            )
        markers = aruco.getPredefinedDictionary(number)
        needed, available = self.columns * self.rows // 2, len(markers.bytesList)
        if needed > available:
            raise ConfigError(
                f"A board of {self.columns} x {self.rows} squares needs {needed} markers, {self.dictionary} has "
                f"{available}; take a larger dictionary or fewer squares."
            )
        side = self.square_metres
        board = aruco.CharucoBoard((self.columns, self.rows), side, side * self.marker_share, markers)
        board.setLegacyPattern(marker_first)
        return board


def dictionaries() -> list[str]:
    """The names of OpenCV's predefined dictionaries."""
    return sorted(name for name in dir(opencv().aruco) if name.startswith("DICT_") and name.isupper())


MIN_CORNERS = 6
MIN_SIGHTINGS = 4
WRONG_LAYOUT = 0.5
MANY_MARKERS = 6


@dataclass(frozen=True)
class Sighting:
    """The board in one picture."""

    instant: int  # index of the picture
    corners: Indices  # ``[S]`` indices into the board's corners
    pixels: NDArray[np.float64]  # ``[S, 2]``, the top-left pixel's centre at (0.5, 0.5)


def board_sightings(
    pictures: Mapping[str, Sequence[NDArray[np.uint8]]], board: Board
) -> dict[str, tuple[Sighting, ...]]:
    """The sightings with enough corners of every camera.

    Raises:
        CalibrationError: a camera that shows the board too rarely, or another board than given.
    """
    found: dict[str, list[Sighting]] = {name: [] for name in pictures}
    markers = {name: set[int]() for name in pictures}
    without_corners = 0
    tasks = [(name, instant) for name, shots in pictures.items() for instant in range(len(shots))]
    with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
        detections = pool.map(lambda task: _sighted(pictures[task[0]][task[1]], board), tasks)
        for (name, instant), (corners, pixels, ids) in zip(tasks, detections, strict=True):
            markers[name] |= ids
            across, down = corners % (board.columns - 1), corners // (board.columns - 1)
            is_line = len(np.unique(across)) < 2 or len(np.unique(down)) < 2
            if len(corners) >= MIN_CORNERS and not is_line:
                found[name].append(Sighting(instant, corners, pixels))
            elif len(ids) >= MANY_MARKERS and len(corners) == 0:
                without_corners += 1
    if without_corners > sum(map(len, found.values())):
        raise CalibrationError(
            f"{without_corners} pictures show markers of {board.dictionary}, but not where a board of {board.text} has "
            "them; give the board's real numbers of squares and markers, as printed on its page."
        )
    _check_markers(pictures, board, markers, found)
    _check_layout(board, found)
    if not any(found.values()):
        raise CalibrationError(
            f"No camera shows the board ({board.text}) in any of its {max(map(len, pictures.values()))} pictures that "
            f"were looked at; show it whole, closer and sharper ({MIN_CORNERS} corners are needed), name the board "
            "that was filmed with --board, or the folder in which it was with --board-videos."
        )
    if few := [name for name in pictures if len(found[name]) < MIN_SIGHTINGS]:
        counts = ", ".join(f"{name!r} in {len(found[name])} of {len(pictures[name])} pictures" for name in few)
        raise CalibrationError(
            f"The board ({board.text}) is seen too rarely: by {counts}, where {MIN_SIGHTINGS} with {MIN_CORNERS} "
            "corners each are needed; show it whole, closer and sharper to each camera, tilted in several directions."
        )
    return {name: tuple(own_sightings) for name, own_sightings in found.items()}


def _sighted(picture: NDArray[np.uint8], board: Board) -> tuple[Indices, NDArray[np.float64], set[int]]:
    """Corners, their pixels, and the markers that were read."""
    cv2 = opencv()
    grey = cv2.cvtColor(np.ascontiguousarray(picture), cv2.COLOR_RGB2GRAY)
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_NONE  # of markers; chessboard corners always are
    pixels: Any = None
    corners: Any = None
    ids: Any = None
    for marker_first in (False, True)[: 2 - board.rows % 2]:
        layout = board.opencv_board(marker_first=marker_first)
        detector = cv2.aruco.CharucoDetector(layout, cv2.aruco.CharucoParameters(), parameters)
        pixels, corners, _, ids = detector.detectBoard(grey)
        if ids is None or (corners is not None and len(corners)):
            break
    read = set() if ids is None else {int(number) for number in np.ravel(ids)}
    if corners is None or len(corners) == 0:
        return np.empty(0, np.intp), np.empty((0, 2)), read
    return np.ravel(corners).astype(np.intp), np.reshape(pixels, (-1, 2)).astype(np.float64) + 0.5, read


def _check_markers(
    pictures: Mapping[str, Sequence[NDArray[np.uint8]]],
    board: Board,
    markers: Mapping[str, set[int]],
    found: Mapping[str, Sequence[Sighting]],
) -> None:
    """Markers of another dictionary, or more of them than the board has."""
    needed = board.columns * board.rows // 2
    beyond = [name for name, ids in markers.items() if ids and max(ids) >= needed and len(ids) > 3]
    if len(beyond) > len(pictures) / 2:
        largest = max(max(markers[name]) for name in beyond)
        raise CalibrationError(
            f"The pictures show markers up to number {largest}, a board of {board.columns} x {board.rows} squares has "
            f"{needed} of them: give the board's real numbers of squares, as printed on its page."
        )
    if any(found.values()):
        return
    if (other := _other_dictionary(pictures, board)) is not None:
        raise CalibrationError(
            f"The board was given as of {board.dictionary}, but the pictures show markers of {other}; give the "
            "board as printed on its page."
        )


def _other_dictionary(pictures: Mapping[str, Sequence[NDArray[np.uint8]]], board: Board) -> str | None:
    """The dictionary of which a few pictures show most markers, if that is not the board's."""
    cv2 = opencv()
    samples = [shots[index] for shots in list(pictures.values())[:4] for index in range(0, len(shots), 8)][:12]
    greys = [cv2.cvtColor(np.ascontiguousarray(sample), cv2.COLOR_RGB2GRAY) for sample in samples]
    counts = {}
    for name in dictionaries():
        detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name)))
        counts[name] = sum(0 if ids is None else len(ids) for _, ids, _ in map(detector.detectMarkers, greys))
    # Of the sizes of one family the smallest that holds all that was seen is the likeliest, and sorts last.
    best = max(counts, key=lambda name: (counts[name], -len(name)))
    return best if counts[best] >= 6 and best.rsplit("_", 1)[0] != board.dictionary.rsplit("_", 1)[0] else None


def _check_layout(board: Board, found: Mapping[str, Sequence[Sighting]]) -> None:
    """Corners that do not lie as on the board: other numbers of squares, or another share of markers."""
    cv2 = opencv()
    wrong, flat = 0, board.corners[:, :2]
    judged = [sighting for own in found.values() for sighting in own if len(sighting.corners) >= 8]
    for sighting in judged:
        H, mask = cv2.findHomography(flat[sighting.corners], sighting.pixels, cv2.RANSAC, 8.0)
        wrong += H is None or mask is None or float(np.mean(mask)) < WRONG_LAYOUT
    if wrong > len(judged) / 2:
        raise CalibrationError(
            f"The corners in {wrong} of {len(judged)} pictures do not lie as on a board of {board.text}; give the "
            "board's real numbers of squares and markers, as printed on its page."
        )


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
"""Width and height in landscape orientation."""

MM_PER_INCH = 25.4
MARGIN_MM = 6.0
FOOT_MM = 14.0
BAR_MM, TICK_MM = 100.0, 0.3
OVERLAP = 1e-4  # of a square, between rows of a marker, so that no hairline shows there


class Rectangle(NamedTuple):
    """A black rectangle of the page, in mm from the page's lower left corner."""

    left: float
    bottom: float
    width: float
    height: float


def write_board_pdf(path: Path, board: Board, paper: Paper = "A4") -> None:
    """A page with ``board`` as vectors in its exact size, a bar of known length to check the print, and its text.

    Raises:
        ConfigError: the board does not fit the paper.
        StorageError: the file cannot be written.
    """
    width, height = board_page(board, paper)
    import_extra("matplotlib", "report")
    from matplotlib.backends.backend_pdf import FigureCanvasPdf
    from matplotlib.figure import Figure
    from matplotlib.patches import Rectangle as Patch

    figure = Figure(figsize=(width / MM_PER_INCH, height / MM_PER_INCH))
    for left, bottom, across, down in (*board_rectangles(board, paper), *_bar()):
        corner = left / width, bottom / height
        figure.add_artist(Patch(corner, across / width, down / height, color="black", linewidth=0))
    left = (MARGIN_MM + BAR_MM + 6) / width
    advice = f"Print at 100 %, without fitting to the page: the bar is {BAR_MM:g} mm long. Glue it to something flat."
    figure.text(left, (MARGIN_MM + 4.5) / height, board.text, fontsize=8, va="bottom")
    figure.text(left, MARGIN_MM / height, advice, fontsize=6.5, va="bottom")
    content = BytesIO()
    FigureCanvasPdf(figure).print_pdf(content, metadata={"CreationDate": None, "Title": f"ChArUco board, {board.text}"})
    atomic_write(path, content.getvalue(), called="The board", new_folder=True)


def board_page(board: Board, paper: Paper) -> tuple[float, float]:
    """Width and height of the page in mm, lying."""
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
    marked = {(int(x), int(y)) for x, y in _marker_corners(board)}
    squares = [(x, y, 1.0, 1.0) for y in range(board.rows) for x in range(board.columns) if (x, y) not in marked]
    return tuple(
        Rectangle(left + x * side, top - (y + down) * side, across * side, down * side)
        for x, y, across, down in (*squares, *_markers(board))
    )


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
                below = OVERLAP if row + 1 < cells else 0.0
                yield x + start * step, y + row * step, (end - start) * step, step + below


def _marker_corners(board: Board) -> list[tuple[float, float]]:
    """Top-left corners of the markers, in squares."""
    found = [np.asarray(corners)[0, :2] / board.square_metres for corners in board.opencv_board().getObjPoints()]
    return [(float(x), float(y)) for x, y in found]


def _bar() -> Iterator[Rectangle]:
    """A bar with a tick at each centimetre."""
    yield Rectangle(MARGIN_MM, MARGIN_MM, BAR_MM, 0.4)
    for step in range(11):
        # The bar's ends are those of its end ticks.
        left = min(max(step * BAR_MM / 10 - TICK_MM / 2, 0.0), BAR_MM - TICK_MM)
        yield Rectangle(MARGIN_MM + left, MARGIN_MM, TICK_MM, 4.0 if step % 5 == 0 else 2.5)
