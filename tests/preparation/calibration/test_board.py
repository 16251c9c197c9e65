# SPDX-License-Identifier: Apache-2.0
"""Boards as values: sizes, corners, dictionaries."""

import numpy as np
import pytest

from structgstream.errors import ConfigError
from structgstream.preparation.calibration.board import Board, dictionaries


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
