# SPDX-License-Identifier: Apache-2.0
"""A planted change of colour is found and undone."""

import numpy as np
import pytest

from structgstream.evaluation.affine import affine_fit, corrected, psnr_affine
from structgstream.evaluation.metrics import PSNR_OF_EQUALS, psnr

PLANTED = np.array([[0.8, 0.1, 0.0, 0.05], [0.05, 0.7, 0.1, 0.02], [0.0, -0.05, 0.9, 0.1]])


def picture(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(30, 200, (24, 31, 3)).astype(np.uint8)


def test_a_planted_matrix_is_recovered() -> None:
    source = picture()
    truth = np.rint(corrected(source, PLANTED)).astype(np.uint8)
    # Rounding of the truth is noise of 0.29 / 255 a value, averaged over 744 pixels.
    np.testing.assert_allclose(affine_fit(source, truth), PLANTED, atol=1e-3)


def test_colour_is_forgiven_and_structure_is_not() -> None:
    source = picture()
    truth = np.rint(corrected(source, PLANTED)).astype(np.uint8)
    assert psnr(source, truth) < 26
    assert psnr_affine(source, truth) > 55  # what rounding leaves
    assert psnr_affine(picture(1), truth) < 20


def test_the_fit_never_loses_on_pictures_inside_the_range() -> None:
    source, truth = picture(), picture(2)
    assert psnr_affine(source, truth) >= psnr(source, truth)


def test_a_picture_of_one_colour_has_a_fit() -> None:
    grey = np.full((6, 7, 3), 90, np.uint8)
    truth = np.full((6, 7, 3), 120, np.uint8)
    assert np.isfinite(affine_fit(grey, truth)).all()
    assert psnr_affine(grey, truth) == pytest.approx(PSNR_OF_EQUALS, abs=250)
    assert psnr_affine(grey, truth) > 80
