# SPDX-License-Identifier: Apache-2.0
import re
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from structgstream.errors import ConfigError
from structgstream.preparation.calibration.board import Board, write_board_pdf

BOARD = Board(7, 5, 0.035)
POINTS_A_MM = 72 / 25.4
NUMBER = rb"(-?[\d.]+)"


def outlines(pdf: bytes) -> tuple[tuple[float, float], list[NDArray[np.float64]]]:
    """The page's size and the black quadrilaterals ``[4, 2]`` drawn on it, in mm from the lower left corner."""
    box = re.search(rb"/MediaBox \[ 0 0 " + NUMBER + rb" " + NUMBER, pdf)
    assert box is not None
    drawn = b""
    for start in re.finditer(rb"(?<!end)stream\r?\n", pdf):
        data = pdf[start.end() : pdf.index(b"endstream", start.end())]
        try:
            content = zlib.decompress(data)
        except zlib.error:
            continue
        drawn = content if b" l\n" in content and len(content) > len(drawn) else drawn
    black = drawn.split(b"0 g", 1)[1]
    corner = NUMBER + rb" " + NUMBER
    quads = re.findall(corner + rb" m\s+" + (corner + rb" l\s+") * 3 + rb"h", black)
    shapes = [np.array([float(value) for value in quad]).reshape(4, 2) / POINTS_A_MM for quad in quads]
    return (float(box[1]) / POINTS_A_MM, float(box[2]) / POINTS_A_MM), shapes


def page(tmp_path: Path, board: Board, paper: str) -> tuple[tuple[float, float], list[NDArray[np.float64]]]:
    write_board_pdf(tmp_path / "board.pdf", board, paper)  # pyright: ignore[reportArgumentType]
    return outlines((tmp_path / "board.pdf").read_bytes())


@pytest.mark.parametrize(("paper", "size"), [("A4", (297, 210)), ("A3", (420, 297)), ("letter", (279.4, 215.9))])
def test_the_page_has_the_size_of_the_paper(tmp_path: Path, paper: str, size: tuple[float, float]) -> None:
    assert page(tmp_path, BOARD, paper)[0] == pytest.approx(size, abs=1e-3)


def test_squares_and_the_bar_have_the_stated_size(tmp_path: Path) -> None:
    _, shapes = page(tmp_path, BOARD, "A4")
    sizes = np.array([np.ptp(shape, axis=0) for shape in shapes])
    squares = (np.abs(sizes - 35) < 1e-3).all(1)
    assert squares.sum() == 18  # of 35, those without a marker
    assert (np.abs(sizes[:, 0] - 100) < 1e-3).sum() == 1  # the bar


@pytest.mark.parametrize("board", [BOARD, Board(8, 6, 0.025, 0.7, "DICT_4X4_100"), Board(6, 9, 0.02, 0.6)])
def test_what_is_printed_is_found_by_a_detector_to_a_hundredth_of_a_millimetre(tmp_path: Path, board: Board) -> None:
    (width, height), shapes = page(tmp_path, board, "A4")
    scale = 12  # pixels a millimetre
    picture = np.full((round(height * scale), round(width * scale)), 255, np.uint8)
    for shape in shapes:
        left, top = shape[:, 0].min() * scale, (height - shape[:, 1].max()) * scale
        right, bottom = shape[:, 0].max() * scale, (height - shape[:, 1].min()) * scale
        picture[round(top) : round(bottom), round(left) : round(right)] = 0
    pixels, corners, _, _ = cv2.aruco.CharucoDetector(board.opencv_board()).detectBoard(picture)
    assert len(corners) == len(board.corners)
    found = (np.reshape(pixels, (-1, 2)) + 0.5) / scale
    wanted = 1000 * board.corners[np.ravel(corners).astype(np.intp)][:, :2]
    shift = (found - wanted).mean(0)
    assert np.abs(found - wanted - shift).max() < 0.1  # pixels are 0.083 mm
    assert 1 - 1e-4 < np.ptp(found[:, 0]) / np.ptp(wanted[:, 0]) < 1 + 1e-3


def test_the_same_board_gives_the_same_bytes_and_the_board_as_text(tmp_path: Path) -> None:
    for name in ("a", "b"):
        write_board_pdf(tmp_path / name, BOARD)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()
    assert b"7 x 5 squares of 35 mm, markers 26.25 mm, DICT_5X5_100" in (tmp_path / "a").read_bytes()


def test_a_board_that_does_not_fit_says_what_would(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="does not fit A4, which has room for 285 x 184 mm; take squares of 36 mm"):
        write_board_pdf(tmp_path / "board.pdf", Board(7, 5, 0.05))
