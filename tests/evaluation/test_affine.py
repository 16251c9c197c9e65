# SPDX-License-Identifier: Apache-2.0
"""A planted change of colour is found and undone."""

import numpy as np
import pytest

from structgstream.evaluation.metrics import (
    PSNR_OF_EQUALS,
    ChannelFit,
    channel_fit,
    psnr,
    psnr_affine,
    psnr_camera_color,
)

PLANTED = np.array([[0.8, 0.1, 0.0, 0.05], [0.05, 0.7, 0.1, 0.02], [0.0, -0.05, 0.9, 0.1]])


def picture(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(30, 200, (24, 31, 3)).astype(np.uint8)


def recolored(source: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """``source`` ``[H, W, 3]`` through a 3x4 colour matrix, whose last column is a bias, full scale 1."""
    through = source @ matrix[:, :3].T + 255.0 * matrix[:, 3]
    return np.rint(np.clip(through, 0, 255)).astype(np.uint8)


def test_colour_is_forgiven_and_structure_is_not() -> None:
    source = picture()
    truth = recolored(source, PLANTED)
    assert psnr(source, truth) < 26
    assert psnr_affine(source, truth) > 55  # what rounding leaves
    assert psnr_affine(picture(1), truth) < 20


def test_the_fit_never_loses_on_pictures_inside_the_range() -> None:
    source, truth = picture(), picture(2)
    assert psnr_affine(source, truth) >= psnr(source, truth)


def test_a_picture_of_one_colour_has_a_fit() -> None:
    grey = np.full((6, 7, 3), 90, np.uint8)
    truth = np.full((6, 7, 3), 120, np.uint8)
    assert psnr_affine(grey, truth) > 80


EXPOSURE = ChannelFit(gains=(1.2, 0.8, 1.0), biases=(-0.05, 0.04, 0.0))
IDENTITY = ChannelFit(gains=(1.0, 1.0, 1.0), biases=(0.0, 0.0, 0.0))


def taken(scene: np.ndarray, fit: ChannelFit = EXPOSURE) -> np.ndarray:
    """What a camera of that exposure records."""
    return recolored(scene, np.column_stack([np.diag(fit.gains), fit.biases]))


def test_a_cameras_gain_and_bias_are_found_in_one_frame_and_hold_in_another() -> None:
    fit = channel_fit(picture(), taken(picture()))
    np.testing.assert_allclose(fit.gains, EXPOSURE.gains, atol=1e-3)
    np.testing.assert_allclose(fit.biases, EXPOSURE.biases, atol=1e-3)
    later = picture(1)
    assert psnr(later, taken(later)) < 30
    assert psnr_camera_color(later, taken(later), fit) > 55  # what rounding leaves


def test_a_held_fit_does_not_forgive_light_that_changes_nor_colours_that_mix() -> None:
    fit = channel_fit(picture(), taken(picture()))
    later = picture(1)
    darker = taken(later, ChannelFit(gains=(0.6, 0.6, 0.6), biases=EXPOSURE.biases))
    assert psnr_camera_color(later, darker, fit) < 20 < psnr_affine(later, darker)
    mixed = recolored(later, PLANTED)
    assert psnr_camera_color(later, mixed, channel_fit(later, mixed)) < psnr_affine(later, mixed) - 10


def test_the_identity_leaves_psnr_as_it_is_and_the_fit_of_a_frame_does_not_lower_it() -> None:
    source, truth = picture(), picture(2)
    assert psnr_camera_color(source, truth, IDENTITY) == pytest.approx(psnr(source, truth))
    assert psnr_camera_color(source, truth, channel_fit(source, truth)) >= psnr(source, truth)
    assert psnr_camera_color(source, source, IDENTITY) == PSNR_OF_EQUALS


def test_a_channel_of_one_value_is_shifted_and_not_stretched() -> None:
    grey, truth = np.full((6, 7, 3), 90, np.uint8), picture()[:6, :7]
    fit = channel_fit(grey, truth)
    assert fit.gains == (1.0, 1.0, 1.0)
    np.testing.assert_allclose(fit.biases, truth.mean((0, 1)) / 255 - 90 / 255, atol=1e-12)
