# SPDX-License-Identifier: Apache-2.0
"""Metrics against closed forms and scikit-image."""

import numpy as np
import pytest
import torch
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from structgstream.evaluation.metrics import PSNR_OF_EQUALS, mse, psnr, quantised, ssim, ssim_map


def pictures(height: int = 37, width: int = 53) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    truth = rng.integers(0, 256, (height, width, 3))
    truth = (truth + np.roll(truth, 1, 0) + np.roll(truth, 1, 1)) // 3
    noisy = np.clip(truth + rng.normal(0, 12, truth.shape), 0, 255)
    return noisy.astype(np.uint8), truth.astype(np.uint8)


def test_a_rendering_is_clamped_and_rounded_before_it_is_scored() -> None:
    image = torch.tensor([-0.2, 0.0, 0.5, 0.501, 1.0, 1.7]).reshape(1, 2, 3)
    assert quantised(image).ravel().tolist() == [0, 0, 128, 128, 255, 255]


def test_psnr_of_a_constant_offset() -> None:
    truth = np.full((8, 9, 3), 100, np.uint8)
    assert psnr(truth + np.uint8(10), truth) == pytest.approx(20 * np.log10(255 / 10))


def test_psnr_agrees_with_scikit_image() -> None:
    picture, truth = pictures()
    assert psnr(picture, truth) == pytest.approx(peak_signal_noise_ratio(truth, picture), abs=1e-9)


def test_equal_pictures_have_a_finite_psnr() -> None:
    picture, _ = pictures()
    assert psnr(picture, picture) == PSNR_OF_EQUALS


def test_mse_of_a_mask_sees_its_pixels_only() -> None:
    truth = np.zeros((4, 4, 3), np.uint8)
    picture = truth.copy()
    picture[0, 0] = 255
    where = np.zeros((4, 4), bool)
    assert np.isnan(mse(picture, truth, where=where))
    where[0, :2] = True
    assert mse(picture, truth, where=where) == pytest.approx(0.5)
    assert mse(picture, truth, where=~where) == 0.0


def test_ssim_away_from_the_border_agrees_with_scikit_image() -> None:
    picture, truth = pictures()
    _, theirs = structural_similarity(
        truth,
        picture,
        channel_axis=2,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        full=True,
    )
    ours = ssim_map(picture, truth).permute(1, 2, 0).numpy()
    # float32 moments: 1e-7 of a squared mean against the 9e-4 of C2.
    np.testing.assert_allclose(ours[5:-5, 5:-5], theirs[5:-5, 5:-5], atol=1e-4)


def test_ssim_treats_what_lies_beyond_the_border_as_black() -> None:
    picture, truth = pictures()
    black = [np.pad(p, ((5, 5), (5, 5), (0, 0))) for p in (picture, truth)]
    inner = ssim_map(*black)[:, 5:-5, 5:-5]
    torch.testing.assert_close(ssim_map(picture, truth), inner, atol=1e-5, rtol=0)


def test_ssim_of_equals_is_one_and_falls_with_noise() -> None:
    picture, truth = pictures()
    assert ssim(truth, truth) == pytest.approx(1.0)
    assert ssim(picture, truth) < 0.99
    assert ssim(255 - truth, truth) < ssim(picture, truth)
