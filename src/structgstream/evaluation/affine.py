# SPDX-License-Identifier: Apache-2.0
"""What is left of an error once colour is set aside.

A held-out camera's exposure and white balance are unknown to training, so a part of its error says nothing of
the scene. The best affine change of colour, fitted on the very picture that is scored, bounds that part. It
uses the truth, so it is never a headline: reports label it ``psnr_affine``.
"""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from structgstream.evaluation.metrics import decibels

CHUNK = 256  # pixels: so many products of bytes add up exactly in float32


def affine_fit(picture: NDArray[np.uint8], truth: NDArray[np.uint8]) -> NDArray[np.float64]:
    """The 3x4 matrix ``A`` with the least squared error of ``A [r, g, b, 1]`` (0 to 1) against ``truth``.

    Both pictures are ``[H, W, 3]`` uint8. A picture of one colour has many solutions; the smallest is
    returned.
    """
    return _fitted(_planes(picture, truth))


def corrected(picture: NDArray[np.uint8], matrix: NDArray[np.float64]) -> NDArray[np.float32]:
    """``picture`` ``[H, W, 3]`` through a 3x4 colour matrix, 0 to 255, clamped and not rounded."""
    height, width, _ = picture.shape
    through = _through(_planes(picture), matrix)
    return through[:, : height * width].T.reshape(height, width, 3).numpy()


def psnr_affine(picture: NDArray[np.uint8], truth: NDArray[np.uint8]) -> float:
    """PSNR of ``picture`` after its best affine change of colour towards ``truth``, dB."""
    planes = _planes(picture, truth)
    pixels = truth.size // 3
    difference = _through(planes[:4], _fitted(planes))[:, :pixels] - planes[4:].flatten(1)[:, :pixels]
    return decibels(float(difference.square_().sum(dtype=torch.float64)) / (255.0**2 * truth.size))


def _planes(*pictures: NDArray[np.uint8]) -> Tensor:
    """Ones and then the channels of the pictures, ``[1 + 3 n, chunks, CHUNK]`` float32, zeros after the last pixel.

    The work on them is torch's: NumPy's BLAS leaves threads that spin while the next picture is drawn, which then took
    half as long again (2 cores).
    """
    pixels = pictures[0].size // 3
    planes = np.zeros((1 + 3 * len(pictures), -(-pixels // CHUNK) * CHUNK), np.float32)
    planes[0, :pixels] = 1.0
    for i, picture in enumerate(pictures):
        for channel in range(3):
            planes[1 + 3 * i + channel, :pixels] = picture[..., channel].ravel()
    return torch.from_numpy(planes).reshape(len(planes), -1, CHUNK)


def _fitted(planes: Tensor) -> NDArray[np.float64]:
    # The normal equations are 4x4, so the fit costs a pass over the pixels.
    products = (planes.transpose(0, 1) @ planes.permute(1, 2, 0)).sum(0, dtype=torch.float64)  # [7, 7]
    scale = torch.tensor([1.0] + 6 * [255.0], dtype=torch.float64)
    products = (products / (scale[:, None] * scale)).numpy()
    solution = np.linalg.lstsq(products[:4, :4], products[:4, 4:], rcond=None)[0].T
    return np.roll(solution, -1, axis=1).astype(np.float64)  # the ones come last in the matrix


def _through(planes: Tensor, matrix: NDArray[np.float64]) -> Tensor:
    """The first four planes through a 3x4 matrix, ``[3, pixels]``, 0 to 255, clamped."""
    scaled = torch.from_numpy(np.roll(matrix * [1.0, 1.0, 1.0, 255.0], 1, axis=1)).float()
    return (scaled @ planes.flatten(1)).clamp_(0.0, 255.0)
