# SPDX-License-Identifier: Apache-2.0
"""What is left of an error once colour is set aside.

A held-out camera's exposure and white balance are unknown to training, so a part of its error says nothing of
the scene. The best affine change of colour, fitted on the very picture that is scored, bounds that part. It
uses the truth, so it is never a headline: reports label it ``psnr_affine``.
"""

import numpy as np
from numpy.typing import NDArray

from structgstream.evaluation.metrics import decibels


def affine_fit(picture: NDArray[np.uint8], truth: NDArray[np.uint8]) -> NDArray[np.float64]:
    """The 3x4 matrix ``A`` with the least squared error of ``A [r, g, b, 1]`` (0 to 1) against ``truth``.

    Both pictures are ``[H, W, 3]`` uint8. A picture of one colour has many solutions; the smallest is
    returned.
    """
    both = np.concatenate([picture.reshape(-1, 3), truth.reshape(-1, 3)], axis=1).astype(np.float64)  # [P, 6]
    # The normal equations are 4x4, so the fit costs a pass over the pixels; products of bytes add up exactly.
    products, sums = both.T @ both, np.ones(len(both)) @ both
    left = np.empty((4, 4))
    left[:3, :3] = products[:3, :3] / 255.0**2
    left[3, :3] = left[:3, 3] = sums[:3] / 255.0
    left[3, 3] = len(both)
    right = np.concatenate([products[:3, 3:] / 255.0**2, sums[None, 3:] / 255.0])
    return np.linalg.lstsq(left, right, rcond=None)[0].T.astype(np.float64)


def corrected(picture: NDArray[np.uint8], matrix: NDArray[np.float64]) -> NDArray[np.float32]:
    """``picture`` ``[H, W, 3]`` through a 3x4 colour matrix, 0 to 255, clamped and not rounded."""
    through = picture.reshape(-1, 3).astype(np.float32) @ matrix[:, :3].T.astype(np.float32)
    through += (255.0 * matrix[:, 3]).astype(np.float32)
    return np.clip(through, 0.0, 255.0, out=through).reshape(picture.shape)


def psnr_affine(picture: NDArray[np.uint8], truth: NDArray[np.uint8]) -> float:
    """PSNR of ``picture`` after its best affine change of colour towards ``truth``, dB."""
    difference = corrected(picture, affine_fit(picture, truth))
    difference -= truth
    rows = np.square(difference, out=difference).reshape(len(difference), -1).mean(axis=1)
    return decibels(float(rows.mean(dtype=np.float64)) / 255.0**2)
