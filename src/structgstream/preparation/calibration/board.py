# SPDX-License-Identifier: Apache-2.0
"""A ChArUco board: a chessboard whose white squares hold markers (Garrido-Jurado et al., Pattern Recognition 2014)."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from structgstream.data.arrays import Floats
from structgstream.data.images import opencv
from structgstream.errors import ConfigError


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
        """One line that says everything that is needed to use the print."""
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
        needed, held = self.columns * self.rows // 2, len(markers.bytesList)
        if needed > held:
            raise ConfigError(
                f"A board of {self.columns} x {self.rows} squares needs {needed} markers, {self.dictionary} has "
                f"{held}; take a larger dictionary or fewer squares."
            )
        side = self.square_metres
        return aruco.CharucoBoard((self.columns, self.rows), side, side * self.marker_share, markers)


def dictionaries() -> list[str]:
    """The names of OpenCV's predefined dictionaries."""
    return sorted(name for name in dir(opencv().aruco) if name.startswith("DICT_") and name.isupper())
