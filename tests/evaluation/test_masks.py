# SPDX-License-Identifier: Apache-2.0
"""Changed pixels of planted changes."""

import numpy as np
import pytest

from structgstream.evaluation.metrics import changed_pixels, dilate


def test_nothing_changed() -> None:
    picture = np.random.default_rng(0).integers(0, 256, (20, 30, 3)).astype(np.uint8)
    assert not changed_pixels(picture, picture).any()


def test_a_moved_square_is_found_with_its_rim() -> None:
    first = np.full((40, 40, 3), 50, np.uint8)
    truth = first.copy()
    truth[10:20, 12:22] = 250
    mask = changed_pixels(truth, first)
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    # One pixel beyond the edge a third of the window has changed, by 0.78: above 0.1. Dilation adds three.
    assert (rows[0], rows[-1], columns[0], columns[-1]) == (6, 23, 8, 25)
    assert mask[10:20, 12:22].all()


def test_the_rim_is_as_wide_in_the_scene_in_a_larger_picture() -> None:
    first = np.full((360, 960, 3), 50, np.uint8)
    truth = first.copy()
    truth[100:200, 120:220] = 250
    columns = np.flatnonzero(changed_pixels(truth, first).any(0))
    assert (columns[0], columns[-1]) == (114, 225)  # one pixel of the mean and 3 x 960 / 640, rounded up


@pytest.mark.parametrize(("change", "found"), [(25, False), (26, True)])
def test_the_threshold_is_a_tenth_of_full_scale(change: int, found: bool) -> None:
    first = np.full((16, 16, 3), 100, np.uint8)
    assert changed_pixels(first + np.uint8(change), first).all() == found


def test_noise_of_a_pixel_is_averaged_away() -> None:
    first = np.full((16, 16, 3), 100, np.uint8)
    truth = first.copy()
    truth[8, 8] += 150  # 0.59 of full scale, 0.065 over nine pixels
    assert not changed_pixels(truth, first).any()


def test_dilation_is_a_square_that_stays_in_the_picture() -> None:
    mask = np.zeros((9, 12), bool)
    mask[0, 0] = mask[6, 7] = True
    expected = np.zeros_like(mask)
    expected[:3, :3] = expected[4:9, 5:10] = True
    np.testing.assert_array_equal(dilate(mask, 2), expected)
