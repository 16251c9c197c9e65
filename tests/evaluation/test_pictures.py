# SPDX-License-Identifier: Apache-2.0
"""Comparisons have the pixels they claim."""

from pathlib import Path

import cv2
import numpy as np

from structgstream.evaluation.pictures import (
    LARGEST_TILE,
    contact_sheet,
    difference,
    side_by_side,
    spread_indices,
    thumbnail,
)
from tests.support.drawn import pixels_of


def test_difference_is_four_times_the_error_and_clamped() -> None:
    picture = np.array([[[10, 200, 0]]], np.uint8)
    truth = np.array([[[20, 100, 0]]], np.uint8)
    assert difference(picture, truth).ravel().tolist() == [40, 255, 0]


def test_side_by_side_is_truth_rendering_difference() -> None:
    truth, picture = np.full((5, 6, 3), 100, np.uint8), np.full((5, 6, 3), 110, np.uint8)
    row = side_by_side(truth, picture)[2, :, 0].tolist()
    assert row == [100] * 6 + [255] * 4 + [110] * 6 + [255] * 4 + [40] * 6


def test_thumbnails_are_block_means() -> None:
    picture = np.zeros((6, 2 * LARGEST_TILE, 3), np.uint8)
    picture[:2, :2] = [[[0], [100]], [[100], [200]]]
    small = thumbnail(picture)
    assert small.shape == (3, LARGEST_TILE, 3)
    assert small[0, 0, 0] == 100
    np.testing.assert_array_equal(thumbnail(small), small)


def test_sampled_frames_hold_the_first_and_the_last() -> None:
    assert spread_indices(12, 4) == [0, 4, 7, 11]
    assert spread_indices(2, 5) == [0, 1]
    assert spread_indices(1, 5) == [0]


def test_a_contact_sheet_shows_every_picture_pixel_for_pixel(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    cells = {
        name: {i: tuple(rng.integers(0, 256, (30, 40, 3)).astype(np.uint8) for _ in range(2)) for i in (0, 3)}
        for name in ("a", "b")
    }
    contact_sheet(tmp_path / "sheet.png", cells, title="a result")  # pyright: ignore[reportArgumentType]
    sheet = pixels_of(tmp_path / "sheet.png")
    for pictures in cells.values():
        for pair in pictures.values():
            for picture in pair:
                found = cv2.matchTemplate(sheet.copy(), picture, cv2.TM_SQDIFF).min()
                assert (
                    found < 100
                )  # the transform rounds at 1e-7 of sums near 1e8; one wrong level everywhere gives 3600
