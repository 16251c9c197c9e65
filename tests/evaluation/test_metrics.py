# SPDX-License-Identifier: Apache-2.0
"""Metrics against closed forms and scikit-image."""

import numpy as np
import pytest
import torch
from pytorch_msssim import ms_ssim as their_ms_ssim
from skimage.metrics import peak_signal_noise_ratio

from structgstream.evaluation.metrics import (
    PSNR_OF_EQUALS,
    ms_ssim,
    psnr,
    squared_errors,
    ssim,
)
from structgstream.scene.render import to_8bit_image
from tests.support.backends import quickest_backend


def pictures(height: int = 37, width: int = 53) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    truth = rng.integers(0, 256, (height, width, 3))
    truth = (truth + np.roll(truth, 1, 0) + np.roll(truth, 1, 1)) // 3
    noisy = np.clip(truth + rng.normal(0, 12, truth.shape), 0, 255)
    return noisy.astype(np.uint8), truth.astype(np.uint8)


def test_a_rendering_is_clamped_and_rounded_before_it_is_scored() -> None:
    image = torch.tensor([-0.2, 0.0, 0.5, 0.501, 1.0, 1.7]).reshape(1, 2, 3)
    assert to_8bit_image(image).ravel().tolist() == [0, 0, 128, 128, 255, 255]


def test_psnr_agrees_with_scikit_image() -> None:
    picture, truth = pictures()
    assert psnr(picture, truth) == pytest.approx(peak_signal_noise_ratio(truth, picture), abs=1e-9)


def test_equal_pictures_have_a_finite_psnr() -> None:
    picture, _ = pictures()
    assert psnr(picture, picture) == PSNR_OF_EQUALS


def test_the_ssim_of_a_mask_is_the_mean_of_its_pixels() -> None:
    """What the numbers are: kernels/test_reference_losses.py and parity/test_ssim.py."""
    picture, truth = pictures()
    left, right = np.zeros((2, *truth.shape[:2]), bool)
    left[:, :20] = right[:, 20:] = True
    halves = [ssim(picture, truth, quickest_backend(), mask) for mask in (left, right)]
    whole = ssim(picture, truth, quickest_backend())
    assert (20 * halves[0] + 33 * halves[1]) / 53 == pytest.approx(whole, abs=1e-6)
    assert halves[0] != pytest.approx(halves[1], abs=1e-4)


@pytest.mark.parametrize(("height", "width"), [(176, 208), (161, 171), (181, 200)])
def test_ms_ssim_agrees_with_pytorch_msssim(height: int, width: int) -> None:
    picture, truth = pictures(height, width)
    ours, theirs = ms_ssim(picture, truth), []
    for dtype in (torch.float32, torch.float64):
        a, b = (torch.from_numpy(p).permute(2, 0, 1)[None].to(dtype) for p in (picture, truth))
        theirs.append(float(their_ms_ssim(a, b, data_range=255)))
    assert theirs[0] < 0.99
    assert ours == pytest.approx(theirs[1], abs=1e-5)


def test_ms_ssim_of_equals_opposites_and_small_pictures() -> None:
    _, truth = pictures(170, 180)
    assert ms_ssim(truth, truth) == pytest.approx(1.0)
    assert ms_ssim(255 - truth, truth) == 0.0  # negative structure counts as none
    assert ms_ssim(*pictures(160, 200)) is None


def test_squared_errors_are_exact() -> None:
    picture, truth = pictures()
    errors = squared_errors(picture, truth)
    np.testing.assert_array_equal(errors, ((picture.astype(int) - truth.astype(int)) ** 2).sum(2))
    expected = np.mean((picture / 255.0 - truth / 255.0) ** 2)
    assert psnr(picture, truth) == pytest.approx(-10 * np.log10(expected), rel=1e-12)
