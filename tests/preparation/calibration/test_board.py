# SPDX-License-Identifier: Apache-2.0
"""Boards as values: sizes, corners, dictionaries."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from structgstream.data.lenses import LensCamera
from structgstream.errors import CalibrationError, ConfigError
from structgstream.preparation.calibration.board import Board, board_sightings, dictionaries
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
