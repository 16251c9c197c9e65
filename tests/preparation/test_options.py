# SPDX-License-Identifier: Apache-2.0
"""Options as they are written on the command line."""

import math

import pytest

from structgstream.errors import ConfigError
from structgstream.preparation.calibration.board import Board
from structgstream.preparation.options import (
    PrepareOptions,
    board_text,
    parse_board,
    parse_distance,
    parse_length,
    parse_size,
)


def test_lengths() -> None:
    assert [parse_length(text) for text in ("3.2m", "320cm", "3200 mm")] == pytest.approx([3.2] * 3)
    assert parse_length("10ft") == pytest.approx(3.048)
    for wrong in ("", "m", "-1m", "0m", "3 parsec", "50"):
        with pytest.raises(ConfigError, match="positive number with its unit"):
            parse_length(wrong)


def test_distances_and_sizes() -> None:
    assert parse_distance("a", "b", "50mm").metres == pytest.approx(0.05)
    with pytest.raises(ConfigError, match="'a' twice"):
        parse_distance("a", "a", "1m")
    assert parse_size("1280x720") == (1280, 720)
    with pytest.raises(ConfigError, match="WIDTHxHEIGHT"):
        parse_size("720p")


@pytest.mark.parametrize("board", [Board(), Board(9, 6, 0.08), Board(6, 4, 0.1, dictionary="DICT_4X4_50")])
def test_a_board_is_named_and_read(board: Board) -> None:
    assert parse_board(board_text(board)) == board


def test_what_names_no_board() -> None:
    for text in ("7x5", "7:50mm", "7 5:50mm", "0x5:50mm", "7x5:50mm:a:b", "", "9" * 5000 + "x5:50mm"):
        with pytest.raises(ConfigError, match="COLUMNSxROWS:SQUARE"):
            parse_board(text)


@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, math.inf])
def test_numbers_that_cannot_be(value: float) -> None:
    with pytest.raises(ConfigError, match="The near plane must be positive"):
        PrepareOptions(near=value)
    with pytest.raises(ConfigError, match="Frames a second must be positive"):
        PrepareOptions(fps=value)
    with pytest.raises(ConfigError, match="at least one instant"):
        PrepareOptions(instants=0)


@pytest.mark.parametrize("degrees", [0.0, -5.0, 175.0, math.nan])
def test_a_field_of_view_that_no_plane_has(degrees: float) -> None:
    with pytest.raises(ConfigError, match="field of view of less than 175"):
        PrepareOptions(field_of_view=degrees)
