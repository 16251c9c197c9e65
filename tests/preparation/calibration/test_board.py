# SPDX-License-Identifier: Apache-2.0
"""Boards as values, where pictures show them, and their page."""

import re
import zlib
from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from structgstream.data.lenses import LensCamera
from structgstream.errors import CalibrationError, ConfigError
from structgstream.preparation.calibration.board import Board, board_sightings, dictionaries, write_board_pdf
from tests.support.filmed import Film, board_plane, ring, turned


@pytest.mark.parametrize(("columns", "rows"), [(7, 5), (5, 7), (3, 4), (12, 9)])
def test_corners_are_those_of_opencv(columns: int, rows: int) -> None:
    board = Board(columns, rows, 0.05)
    assert len(board.corners) == (columns - 1) * (rows - 1)
    charuco = board.opencv_board()
    np.testing.assert_allclose(board.corners, np.asarray(charuco.getChessboardCorners()), atol=1e-7)
    assert board.size_metres == pytest.approx((columns * 0.05, rows * 0.05))


NO_NUMBER = float("nan")


@pytest.mark.parametrize(
    "values",
    [(2, 5, 0.05), (7, 2, 0.05), (7, 5, 0.0), (7, 5, -1.0), (7, 5, NO_NUMBER), (7, 5, 0.05, 0.2), (7, 5, 0.05, 1.0)],
)
def test_sizes_that_make_no_board(values: tuple) -> None:
    with pytest.raises(ConfigError, match="cannot be made; it needs 3 x 3 squares or more"):
        Board(*values)


@pytest.mark.parametrize(("side", "instead"), [(5, "5 x 4"), (3, "3 x 4")])
def test_a_square_board_looks_alike_when_turned(side: int, instead: str) -> None:
    with pytest.raises(ConfigError, match=f"looks alike when turned; take unequal numbers, such as {instead}"):
        Board(side, side)


@pytest.mark.parametrize("name", ["DICT_9X9_1", "dict_5x5_100", "CharucoBoard", "DICT_", ""])
def test_a_dictionary_that_opencv_lacks(name: str) -> None:
    with pytest.raises(ConfigError, match="is no dictionary of OpenCV's; expected such as DICT_"):
        Board(7, 5, 0.05, dictionary=name).opencv_board()


def test_a_dictionary_with_too_few_markers() -> None:
    assert Board(11, 9, 0.05, dictionary="DICT_4X4_50").opencv_board() is not None
    with pytest.raises(ConfigError, match="13 x 8 squares needs 52 markers, DICT_4X4_50 has 50; take a larger"):
        Board(13, 8, 0.05, dictionary="DICT_4X4_50").opencv_board()


def test_every_dictionary_that_is_listed_makes_a_board() -> None:
    for name in dictionaries():
        if "ARUCO_ORIGINAL" not in name:
            assert Board(3, 4, 0.05, dictionary=name).opencv_board() is not None


BOARD = Board(9, 5, 0.09)
RIG = ring(2, radius=1.1, arc_degrees=30, focal=300, size=(360, 270))
Pictures = dict[str, list[NDArray[np.uint8]]]


def pose_of(instant: int) -> NDArray[np.float64]:
    pose = np.eye(4)
    pose[:3, :3] = turned(14.0 * instant - 28, axis=1) @ turned(8.0 * instant - 16, axis=0)
    pose[:3, 3] = pose[:3, :3] @ (-0.4, -0.22, 0.0) + (0.03 * instant, 0.0, 0.03 * instant - 0.35)
    return pose


@cache
def filmed() -> Pictures:
    films = {name: Film(camera) for name, camera in RIG.items()}
    return {
        name: [film.picture([board_plane(BOARD, pose_of(instant))], noise=1, seed=instant) for instant in range(5)]
        for name, film in films.items()
    }


def expected(camera: LensCamera, instant: int) -> NDArray[np.float64]:
    pose = pose_of(instant)
    return camera.pixels(BOARD.corners @ pose[:3, :3].T + pose[:3, 3])


def test_corners_are_seen_where_they_are() -> None:
    """In pixels whose first one has its centre at (0.5, 0.5): half a pixel off would be noticed."""
    found = board_sightings(filmed(), BOARD)
    assert {name: [sight.instant for sight in sights] for name, sights in found.items()} == {
        name: list(range(5)) for name in RIG
    }
    for name, sights in found.items():
        apart = np.concatenate([sight.pixels - expected(RIG[name], sight.instant)[sight.corners] for sight in sights])
        assert len(apart) > 0.8 * 5 * len(BOARD.corners)
        assert np.abs(np.median(apart, axis=0)).max() < 0.05
        assert np.median(np.linalg.norm(apart, axis=1)) < 0.15


def test_a_board_of_older_tools_with_an_even_number_of_rows() -> None:
    """It begins with a marker; its corners are where those of the other one are."""
    board = Board(9, 6, 0.09)
    whole = board_plane(board, pose_of(2))
    height, width = whole.texture.shape[:2]
    print_ = board.opencv_board(marker_first=True).generateImage((width, height), marginSize=20)
    pictures = [Film(RIG["cam00"]).picture([replace(whole, texture=print_)], noise=1)]
    (sight,) = board_sightings({"cam00": pictures * 4}, board)["cam00"][:1]
    (other,) = board_sightings({"cam00": [Film(RIG["cam00"]).picture([whole], noise=1)] * 4}, board)["cam00"][:1]
    shared, here, there = np.intersect1d(sight.corners, other.corners, return_indices=True)
    assert len(shared) > 0.6 * len(board.corners)
    np.testing.assert_allclose(sight.pixels[here], other.pixels[there], atol=0.5)


def test_a_row_of_corners_is_no_sighting() -> None:
    """Corners on a line say nothing of the board's tilt: of one picture only the two upper rows of squares are left."""
    whole = board_plane(BOARD, pose_of(2), pixels_a_square=40)
    height = 100  # half a square of margin and two squares
    share = height / len(whole.texture)
    upper = replace(whole, texture=whole.texture[:height], size=(whole.size[0], share * whole.size[1]))
    pictures = {name: [*shots] for name, shots in filmed().items()}
    pictures["cam00"][2] = Film(RIG["cam00"]).picture([upper], noise=1)
    found = board_sightings(pictures, BOARD)
    assert [sight.instant for sight in found["cam00"]] == [0, 1, 3, 4]


def test_too_few_sightings_are_reported_with_their_number() -> None:
    pictures = {**filmed(), "cam01": [*filmed()["cam01"][:3], *[np.full((270, 360, 3), 127, np.uint8)] * 2]}
    with pytest.raises(CalibrationError, match=r"'cam01' in 3 of 5 pictures, where 4 with 6 corners each are needed"):
        board_sightings(pictures, BOARD)


def test_more_markers_than_the_board_has_are_reported() -> None:
    with pytest.raises(CalibrationError, match=r"markers up to number 21, a board of 9 x 4 squares has 18"):
        board_sightings(filmed(), Board(9, 4, 0.09))


PRINTED = Board(7, 5, 0.035)
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
    assert page(tmp_path, PRINTED, paper)[0] == pytest.approx(size, abs=1e-3)


def test_squares_and_the_bar_have_the_stated_size(tmp_path: Path) -> None:
    _, shapes = page(tmp_path, PRINTED, "A4")
    sizes = np.array([np.ptp(shape, axis=0) for shape in shapes])
    squares = (np.abs(sizes - 35) < 1e-3).all(1)
    assert squares.sum() == 18  # of 35, those without a marker
    assert (np.abs(sizes[:, 0] - 100) < 1e-3).sum() == 1  # the bar


@pytest.mark.parametrize("board", [PRINTED, Board(8, 6, 0.025, 0.7, "DICT_4X4_100"), Board(6, 9, 0.02, 0.6)])
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
        write_board_pdf(tmp_path / name, PRINTED)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()
    assert b"7 x 5 squares of 35 mm, markers 26.25 mm, DICT_5X5_100" in (tmp_path / "a").read_bytes()


def test_a_board_that_does_not_fit_says_what_would(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="does not fit A4, which has room for 285 x 184 mm; take squares of 36 mm"):
        write_board_pdf(tmp_path / "board.pdf", Board(7, 5, 0.05))
