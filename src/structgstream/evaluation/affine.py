# SPDX-License-Identifier: Apache-2.0
"""PSNR after a colour correction of the rendering.

A held-out camera's exposure and white balance are unknown in training, so a part of its error is unrelated to the
scene. The best affine colour transform, fitted to the scored picture itself, bounds that part. It uses the ground
truth, so it is never the main result; reports label it ``psnr_affine``.

Note [Colour of a camera]
~~~~~~~~~~~~~~~~~~~~~~~~~
A camera's colour response is constant over time. So ``psnr_camera_color`` fits a gain and a bias per channel to the
camera's first frame, as training does for its cameras (``scene/color.py``), and uses them for all later frames, as if
the camera had been colour-calibrated once. Changing light and local colour errors still count; a fit per frame, or one
that mixes channels, would hide them.
"""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from structgstream.evaluation.metrics import decibels

CHUNK = 256  # pixels whose products of bytes can be added exactly in float32


def psnr_affine(picture: NDArray[np.uint8], truth: NDArray[np.uint8]) -> float:
    """PSNR of ``picture`` after its best affine change of colour towards ``truth``, dB."""
    planes = _planes(picture, truth)
    pixels = truth.size // 3
    difference = _apply_matrix(planes[:4], _fit_matrix(planes))[:, :pixels] - planes[4:].flatten(1)[:, :pixels]
    return decibels(float(difference.square_().sum(dtype=torch.float64)) / (255.0**2 * truth.size))


@dataclass(frozen=True)
class ChannelFit:
    """A camera's colour response, ``gain * rendering + bias`` per channel (Note [Colour of a camera]).

    Args:
        gains: gain of red, green and blue.
        biases: bias of red, green and blue, full scale 1.
    """

    gains: tuple[float, float, float]
    biases: tuple[float, float, float]


def channel_fit(picture: NDArray[np.uint8], truth: NDArray[np.uint8]) -> ChannelFit:
    """The gain and bias of each channel that minimize the squared error of ``picture`` against ``truth``.

    Both are ``[H, W, 3]`` uint8. A constant channel gets gain 1, because it does not determine one.
    """
    pairs = [_fit_line(picture[..., channel], truth[..., channel]) for channel in range(3)]
    (r, g, b), biases = zip(*pairs, strict=True)
    return ChannelFit((r, g, b), biases)


def _fit_line(values: NDArray[np.uint8], targets: NDArray[np.uint8]) -> tuple[float, float]:
    x, y = values.astype(np.float64), targets.astype(np.float64)
    mean_x, mean_y = float(x.mean()), float(y.mean())
    x -= mean_x
    variance = float(np.square(x).sum())
    gain = float((x * (y - mean_y)).sum()) / variance if variance > 0.0 else 1.0
    return gain, (mean_y - gain * mean_x) / 255.0


def psnr_camera_color(picture: NDArray[np.uint8], truth: NDArray[np.uint8], fit: ChannelFit) -> float:
    """PSNR, dB, of ``picture`` corrected by ``fit`` and clamped, not rounded."""
    levels = np.arange(256, dtype=np.float64)
    total = 0.0
    for channel, (gain, bias) in enumerate(zip(fit.gains, fit.biases, strict=True)):
        table = np.clip(gain * levels + 255.0 * bias, 0.0, 255.0).astype(np.float32)
        difference = table[picture[..., channel]] - truth[..., channel]
        total += float(np.square(difference).sum(dtype=np.float64))
    return decibels(total / (255.0**2 * truth.size))


def _planes(*pictures: NDArray[np.uint8]) -> Tensor:
    """A plane of ones, then the channels of the pictures: ``[1 + 3 n, chunks, CHUNK]`` float32, zero-padded.

    Computed with torch, because the spinning threads of NumPy's BLAS slowed the next rendering by half (2 cores).
    """
    pixels = pictures[0].size // 3
    planes = np.zeros((1 + 3 * len(pictures), -(-pixels // CHUNK) * CHUNK), np.float32)
    planes[0, :pixels] = 1.0
    for i, picture in enumerate(pictures):
        for channel in range(3):
            planes[1 + 3 * i + channel, :pixels] = picture[..., channel].ravel()
    return torch.from_numpy(planes).reshape(len(planes), -1, CHUNK)


def _fit_matrix(planes: Tensor) -> NDArray[np.float64]:
    # The normal equations are 4x4, so the fit costs one pass over the pixels.
    products = (planes.transpose(0, 1) @ planes.permute(1, 2, 0)).sum(0, dtype=torch.float64)  # [7, 7]
    scale = torch.tensor([1.0] + 6 * [255.0], dtype=torch.float64)
    products = (products / (scale[:, None] * scale)).numpy()
    solution = np.linalg.lstsq(products[:4, :4], products[:4, 4:], rcond=None)[0].T
    return np.roll(solution, -1, axis=1).astype(np.float64)  # the ones come last in the matrix


def _apply_matrix(planes: Tensor, matrix: NDArray[np.float64]) -> Tensor:
    """The first four planes through a 3x4 matrix, ``[3, pixels]``, 0 to 255, clamped."""
    scaled = torch.from_numpy(np.roll(matrix * [1.0, 1.0, 1.0, 255.0], 1, axis=1)).float()
    return (scaled @ planes.flatten(1)).clamp_(0.0, 255.0)
