# SPDX-License-Identifier: Apache-2.0
"""The options of a preparation, and how they are written on the command line; invalid ones are a ``ConfigError``."""

import math
import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from structgstream.data.timeline import check_rate
from structgstream.data.undistortion import check_field_of_view
from structgstream.errors import ConfigError
from structgstream.preparation.calibration.board import Board
from structgstream.preparation.calibration.lens_terms import LensModel
from structgstream.preparation.synchronization.synchronize import Method

Link = Literal["hard", "symlink", "copy"]
METHODS = ("auto", "sfm", "board")
UNITS_IN_METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001, "km": 1000.0, "in": 0.0254, "ft": 0.3048}


@dataclass(frozen=True)
class Distance:
    """A length that was measured: between the middles of two cameras' lenses, in metres."""

    first: str
    second: str
    metres: float


@dataclass(frozen=True)
class PrepareOptions:
    """How a capture is made.

    Args:
        calibration: ``sfm``, ``board``, ``auto`` (``board`` with ``board_videos``, else a calibration next to the
            videos, else ``sfm``), or a calibration file or the folder that holds one.
        lens: distortion that is estimated: ``pinhole``, ``radial``, ``opencv``, ``brown`` or ``fisheye``; None for
            ``radial`` by structure from motion and ``opencv`` by a board.
        intrinsics: ``shared`` for cameras of one make and zoom, else ``own``.
        refine: adjust a given calibration to the pictures.
        board: what was printed.
        board_videos: videos in which the board is shown to the cameras; None for the videos themselves.
        distance: a measured length that makes the unit metres; None for none.
        synchronize: how clocks are found, see ``preparation.synchronization``.
        field_of_view: degrees across the pictures after undistortion; None for the largest without black borders.
        size: width and height after undistortion, pixels; None for those of the videos.
        held_out: names of cameras, ``("auto",)`` for the one that others surround best, or none.
        near: near plane in the capture's units; None to take it from the points.
        fps: frames a second of pictures; None for 30.
        without: names of cameras to leave out.
        link: how files get into the capture.
        instants: most instants that structure from motion looks at; it looks at three where these have texture enough.
        roving: a video, or a folder of pictures, of a camera that was walked through the set; None without one.
    """

    calibration: str | Path = "auto"
    lens: LensModel | None = None
    intrinsics: Literal["own", "shared"] = "own"
    refine: bool = False
    board: Board = Board()
    board_videos: Path | None = None
    distance: Distance | None = None
    synchronize: Method = "auto"
    field_of_view: float | None = None
    size: tuple[int, int] | None = None
    held_out: tuple[str, ...] = ()
    near: float | None = None
    fps: float | None = None
    without: tuple[str, ...] = ()
    link: Link = "hard"
    instants: int = 9
    roving: Path | None = None

    def __post_init__(self) -> None:
        if self.near is not None and not 0 < self.near < math.inf:
            raise ConfigError(f"The near plane must be positive, got {self.near:g}.")
        if self.fps is not None:
            check_rate(self.fps)
        if self.field_of_view is not None:
            check_field_of_view(self.field_of_view)
        if self.instants < 1:
            raise ConfigError(f"Structure from motion needs at least one instant, got {self.instants}.")


def parse_length(text: str) -> float:
    """A length as it is written on the command line, in metres: ``3.2m``, ``320cm``, ``50mm``, ``10.5ft``."""
    found = re.fullmatch(r"\s*([0-9]*\.?[0-9]+)\s*([a-z]*)\s*", text)
    if found is None or found[2] not in UNITS_IN_METRES or not float(found[1]) > 0:
        raise ConfigError(f"A length is a positive number with its unit, such as 3.2m, 50mm or 10.5ft; got {text!r}.")
    return float(found[1]) * UNITS_IN_METRES[found[2]]


def parse_distance(first: str, second: str, length: str) -> Distance:
    """A distance as it is written on the command line: two cameras and a length."""
    if first == second:
        raise ConfigError(f"A distance is between two cameras, got {first!r} twice.")
    return Distance(first, second, parse_length(length))


def parse_board(text: str) -> Board:
    """A board as it is written on the command line: ``7x5:50mm``, or ``7x5:50mm:DICT_4X4_50``."""
    squares, *rest = text.split(":")
    numbers = _two_numbers(squares)
    if numbers is None or not 1 <= len(rest) <= 2:
        raise ConfigError(f"A board is COLUMNSxROWS:SQUARE, such as 7x5:50mm; got {text!r}.")
    board = Board(*numbers, parse_length(rest[0]))
    return board if len(rest) == 1 else replace(board, dictionary=rest[1])


def board_text(board: Board) -> str:
    """The reverse of :func:`parse_board`."""
    text = f"{board.columns}x{board.rows}:{1000 * board.square_metres:g}mm"
    return text if board.dictionary == Board().dictionary else f"{text}:{board.dictionary}"


def parse_size(text: str) -> tuple[int, int]:
    """A size as it is written on the command line: ``1280x720``."""
    numbers = _two_numbers(text)
    if numbers is None:
        raise ConfigError(f"A size is WIDTHxHEIGHT in pixels, such as 1280x720; got {text!r}.")
    return numbers


def _two_numbers(text: str) -> tuple[int, int] | None:
    """The positive numbers of ``1280x720``; None of any other text."""
    found = re.fullmatch(r"\s*(\d{1,9})\s*x\s*(\d{1,9})\s*", text)
    return (int(found[1]), int(found[2])) if found and int(found[1]) and int(found[2]) else None
