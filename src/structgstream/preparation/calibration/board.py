# SPDX-License-Identifier: Apache-2.0
"""A ChArUco board, and where cameras see it.

A chessboard whose white squares hold markers (Garrido-Jurado et al., Pattern Recognition 2014).
"""

import os
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from structgstream.data.arrays import Floats
from structgstream.data.images import opencv
from structgstream.errors import CalibrationError, ConfigError


@dataclass(frozen=True)
class Board:
    """What is printed.

    Args:
        columns: squares across.
        rows: squares down.
        square_metres: side of a square.
        marker_share: side of a marker, of a square's.
        dictionary: name of one of OpenCV's predefined dictionaries.

    Raises:
        ConfigError: sizes that make no board, or an unknown dictionary.
    """

    columns: int = 7
    rows: int = 5
    square_metres: float = 0.05
    marker_share: float = 0.75
    dictionary: str = "DICT_5X5_100"

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

    def opencv_board(self) -> Any:
        """The board as OpenCV's.

        Raises:
            ConfigError: a dictionary that OpenCV lacks, or with too few markers.
            MissingExtraError: cv2 is not installed.
        """
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
        return aruco.CharucoBoard((self.columns, self.rows), side, side * self.marker_share, markers)


def dictionaries() -> list[str]:
    """The names of OpenCV's predefined dictionaries."""
    return sorted(name for name in dir(opencv().aruco) if name.startswith("DICT_") and name.isupper())


MIN_CORNERS = 6
MIN_SIGHTINGS = 4
WRONG_LAYOUT = 0.5
MANY_MARKERS = 6


@dataclass(frozen=True)
class Sighting:
    """The board in one picture.

    Args:
        instant: index of the picture.
        corners: ``[S]`` indices into the board's corners.
        pixels: ``[S, 2]``, the top-left pixel's centre at (0.5, 0.5).
    """

    instant: int
    corners: NDArray[np.intp]
    pixels: NDArray[np.float64]


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
            if len(corners) >= MIN_CORNERS and not _collinear(corners, board):
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
    few = [name for name in pictures if len(found[name]) < MIN_SIGHTINGS]
    if few:
        raise CalibrationError(_too_few(board, {name: (len(found[name]), len(pictures[name])) for name in few}, found))
    return {name: tuple(own_sightings) for name, own_sightings in found.items()}


def _too_few(board: Board, seen: Mapping[str, tuple[int, int]], found: Mapping[str, Sequence[Sighting]]) -> str:
    """The sentence for cameras with too few of their pictures that show the board."""
    if not any(found.values()):
        largest = max(total for _, total in seen.values())
        return (
            f"No camera shows the board ({board.text}) in any of its {largest} pictures that were looked at; show it "
            f"whole, closer and sharper ({MIN_CORNERS} corners are needed), name the board that was "
            "filmed with --board, or the folder in which it was with --board-videos."
        )
    counts = ", ".join(f"{name!r} in {count} of {total} pictures" for name, (count, total) in seen.items())
    return (
        f"The board ({board.text}) is seen too rarely: by {counts}, where {MIN_SIGHTINGS} with {MIN_CORNERS} corners "
        "each are needed; show it whole, closer and sharper to each camera, tilted in several directions."
    )


def _sighted(picture: NDArray[np.uint8], board: Board) -> tuple[NDArray[np.intp], NDArray[np.float64], set[int]]:
    """Corners, their pixels, and the markers that were read."""
    cv2 = opencv()
    grey = cv2.cvtColor(np.ascontiguousarray(picture), cv2.COLOR_RGB2GRAY)
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_NONE  # of markers; chessboard corners always are
    detector = cv2.aruco.CharucoDetector(board.opencv_board(), cv2.aruco.CharucoParameters(), parameters)
    pixels, corners, _, ids = detector.detectBoard(grey)
    read = set() if ids is None else {int(number) for number in np.ravel(ids)}
    if corners is None or len(corners) == 0:
        return np.empty(0, np.intp), np.empty((0, 2)), read
    return np.ravel(corners).astype(np.intp), np.reshape(pixels, (-1, 2)).astype(np.float64) + 0.5, read


def _collinear(corners: NDArray[np.intp], board: Board) -> bool:
    across, down = corners % (board.columns - 1), corners // (board.columns - 1)
    return len(set(across.tolist())) < 2 or len(set(down.tolist())) < 2


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
    other = _other_dictionary(pictures, board)
    if other is not None:
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
    wrong = total = 0
    flat = board.corners[:, :2]
    for own_sightings in found.values():
        for sighting in own_sightings:
            if len(sighting.corners) < 8:
                continue
            total += 1
            H, mask = cv2.findHomography(flat[sighting.corners], sighting.pixels, cv2.RANSAC, 8.0)
            wrong += H is None or mask is None or float(np.mean(mask)) < WRONG_LAYOUT
    if total and wrong > total / 2:
        raise CalibrationError(
            f"The corners in {wrong} of {total} pictures do not lie as on a board of {board.text}; give the board's "
            "real numbers of squares and markers, as printed on its page."
        )
