# SPDX-License-Identifier: Apache-2.0
"""Measures as others have implemented and published them."""

import numpy as np
from numpy.typing import NDArray
from skimage.metrics import structural_similarity
from torch import Tensor


def published_ssim(image: Tensor, target: Tensor) -> NDArray[np.float64]:
    """scikit-image's map of SSIM ``[H, W, 3]`` with the window of 11 pixels that Wang et al. (2004) have."""
    return structural_similarity(
        image.double().numpy(),
        target.double().numpy(),
        data_range=1.0,
        channel_axis=2,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        full=True,
        truncate=5 / 1.5,
    )[1]
