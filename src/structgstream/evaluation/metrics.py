# SPDX-License-Identifier: Apache-2.0
"""How far a rendering is from the picture that the camera took.

All scores compare 8-bit pictures: a rendering is clamped and rounded first, because that is what anyone sees.
Definitions, and how they relate to those of other projects: ``docs/evaluation.md``.
"""

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import conv2d

PSNR_OF_EQUALS = 100.0  # dB; above what rounding to 8 bits can give, and a number that JSON can hold
WINDOW, SIGMA = 11, 1.5
C1, C2 = 0.01**2, 0.03**2


def quantised(image: Tensor) -> NDArray[np.uint8]:
    """A rendering ``[H, W, 3]`` in sRGB as the 8-bit picture that a viewer sees: clamped, then rounded."""
    return (image.detach().clamp(0.0, 1.0) * 255.0).round().to(torch.uint8).cpu().numpy()


def mse(picture: NDArray, truth: NDArray, *, where: NDArray[np.bool_] | None = None) -> float:
    """Mean squared error in units of full scale, over all channels of some pixels.

    Pictures are ``[H, W, 3]``, uint8 or floats of the same 0 to 255; ``where`` is a mask ``[H, W]`` (None:
    all pixels). NaN when the mask is empty.
    """
    difference = (picture.astype(np.float64) - truth.astype(np.float64)) / 255.0
    if where is not None:
        difference = difference[where]
    return float(np.mean(difference**2)) if difference.size else math.nan


def decibels(error: float) -> float:
    """The PSNR of a mean squared error in units of full scale; 100 dB for no error."""
    return -10.0 * math.log10(error) if error > 0.0 else PSNR_OF_EQUALS


def psnr(picture: NDArray[np.uint8], truth: NDArray[np.uint8]) -> float:
    """Peak signal-to-noise ratio of two 8-bit pictures ``[H, W, 3]``, dB, over all pixels and channels."""
    return decibels(mse(picture, truth))


def ssim_map(picture: NDArray[np.uint8], truth: NDArray[np.uint8]) -> Tensor:
    """Structural similarity of every pixel and channel, ``[3, H, W]`` (Wang et al., 2004).

    Gaussian window of 11 pixels, sigma 1.5; K1 = 0.01, K2 = 0.03, weighted (biased) moments, zeros beyond the
    border.
    """
    a, b = (torch.from_numpy(np.ascontiguousarray(p)).permute(2, 0, 1) / 255.0 for p in (picture, truth))
    offsets = torch.arange(WINDOW, dtype=torch.float32) - WINDOW // 2
    kernel = torch.exp(-(offsets**2) / (2 * SIGMA**2))
    kernel = (kernel / kernel.sum()).expand(15, 1, WINDOW)
    moments = torch.cat([a, b, a * a, b * b, a * b])[None]  # [1, 15, H, W]
    moments = conv2d(moments, kernel[:, :, None, :], padding=(0, WINDOW // 2), groups=15)
    moments = conv2d(moments, kernel[:, :, :, None], padding=(WINDOW // 2, 0), groups=15)
    mean_a, mean_b, square_a, square_b, product = moments.reshape(5, *a.shape)
    variance_a, variance_b = square_a - mean_a**2, square_b - mean_b**2
    covariance = product - mean_a * mean_b
    return ((2 * mean_a * mean_b + C1) * (2 * covariance + C2)) / (
        (mean_a**2 + mean_b**2 + C1) * (variance_a + variance_b + C2)
    )


def ssim(picture: NDArray[np.uint8], truth: NDArray[np.uint8]) -> float:
    """Mean of :func:`ssim_map` over pixels and channels: the value that Gaussian splatting papers print."""
    return float(ssim_map(picture, truth).mean())
