# SPDX-License-Identifier: Apache-2.0
"""What is left of an error once colour is set aside.

A held-out camera's exposure and white balance are unknown to training, so a part of its error says nothing of
the scene. The best affine change of colour, fitted on the very picture that is scored, bounds that part. It
uses the truth, so it is never a headline: reports label it ``psnr_affine``.
"""

import numpy as np
from numpy.typing import NDArray

from structgstream.evaluation.metrics import decibels, mse


def affine_fit(picture: NDArray[np.uint8], truth: NDArray[np.uint8]) -> NDArray[np.float64]:
    """The 3x4 matrix ``A`` with the least squared error of ``A [r, g, b, 1]`` (0 to 1) against ``truth``.

    Both pictures are ``[H, W, 3]`` uint8. A picture of one colour has many solutions; the smallest is
    returned.
    """
    ones = np.ones((picture.size // 3, 1))
    source = np.concatenate([picture.reshape(-1, 3) / 255.0, ones], axis=1)  # [P, 4]
    target = truth.reshape(-1, 3) / 255.0
    # The normal equations are 4x4, so the fit costs two passes over the pixels.
    matrix = np.linalg.lstsq(source.T @ source, source.T @ target, rcond=None)[0].T
    return matrix.astype(np.float64)


def corrected(picture: NDArray[np.uint8], matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """``picture`` ``[H, W, 3]`` through a 3x4 colour matrix, 0 to 255, clamped and not rounded."""
    return np.clip(picture.astype(np.float64) @ matrix[:, :3].T + 255.0 * matrix[:, 3], 0.0, 255.0)


def psnr_affine(picture: NDArray[np.uint8], truth: NDArray[np.uint8]) -> float:
    """PSNR of ``picture`` after its best affine change of colour towards ``truth``, dB."""
    return decibels(mse(corrected(picture, affine_fit(picture, truth)), truth))
