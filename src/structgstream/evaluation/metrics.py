# SPDX-License-Identifier: Apache-2.0
"""Scores of a picture: PSNR, SSIM and MS-SSIM against the camera's picture, over the pixels that masks count.

All metrics compare 8-bit pictures: a rendering is clamped and rounded first, as it is displayed. Definitions, and how
they relate to those of other projects: ``docs/evaluation.md``.

In typical captures nine of ten pixels are static, so a mean over all pixels hides the quality of moving parts. Masks of
changed pixels are computed from the camera's pictures, never from renderings.

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

import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import avg_pool2d, conv2d

from structgstream.cameras import enlargement
from structgstream.errors import CaptureError
from structgstream.evaluation.report import Scores
from structgstream.kernels.backend import Backend
from structgstream.kernels.reference_losses import C1, C2, WINDOW_PIXELS, ssim_map, window

Picture = NDArray[np.uint8]
"""``[H, W, 3]`` sRGB."""
Mask = NDArray[np.bool_]
"""``[H, W]``."""
THRESHOLD = 0.1  # of full scale
SMOOTHED = 1  # half width, pixels, of a 3x3 mean against noise, which does not depend on the picture's size
REACH_PIXELS = 3  # of the dilation, which includes edges; multiplied by the picture's enlargement


def blackened(picture: Picture, mask: Mask | None) -> Picture:
    """``picture`` ``[H, W, 3]``, black where the mask ``[H, W]`` is False; unchanged without a mask."""
    return picture if mask is None else np.where(mask[..., None], picture, np.uint8(0))


def both(mask: Mask | None, other: Mask | None) -> Mask | None:
    """Pixels of both masks; None for all."""
    if mask is None or other is None:
        return other if mask is None else mask
    return mask & other


def changed_pixels(truth: Picture, first: Picture, mask: Mask | None = None) -> Mask:
    """Dilated mask ``[H, W]`` of the pixels that changed since the camera's first picture.

    The absolute difference of the two pictures ``[H, W, 3]``, averaged over channels and 3x3 pixels, is thresholded at
    0.1 of full scale, and the mask dilated by 3 pixels of a picture of the reference size
    (:func:`structgstream.cameras.enlargement`). Pixels outside ``mask`` count as not changed.
    """
    if mask is not None:
        return changed_pixels(blackened(truth, mask), blackened(first, mask)) & mask
    height, width = truth.shape[:2]
    reach = math.floor(REACH_PIXELS * enlargement(width, height) + 0.5)
    return dilate(differing(truth, first, THRESHOLD * 255), reach)


def differing(one: Picture, other: Picture, levels: float) -> Mask:
    """Mask ``[H, W]`` of the pixels where two pictures ``[H, W, 3]`` differ by more than ``levels`` of 255.

    The absolute difference is averaged over channels and 3x3 pixels.
    """
    # Sums of integers: exact, and half the memory of floats.
    channels = np.abs(np.subtract(one, other, dtype=np.int16))
    difference = channels[..., 0] + channels[..., 1] + channels[..., 2]
    padded = np.pad(difference, SMOOTHED, mode="edge")
    height, width = difference.shape
    size = 2 * SMOOTHED + 1
    across = sum((padded[:, x : x + width] for x in range(1, size)), start=padded[:, :width])
    total = sum((across[y : y + height] for y in range(1, size)), start=across[:height])
    return total > levels * (3 * size**2)


def dilate(mask: Mask, pixels: int) -> Mask:
    """``mask`` ``[H, W]`` dilated by a square that reaches ``pixels`` to each side."""
    return _dilate_down(_dilate_down(mask, pixels).T, pixels).T


def _dilate_down(mask: Mask, pixels: int) -> Mask:
    result = mask.copy()
    for step in range(1, pixels + 1):
        result[step:] |= mask[:-step]
        result[:-step] |= mask[step:]
    return result


PSNR_OF_EQUALS = 100.0  # dB; above any PSNR of different 8-bit pictures, and representable in JSON
SCALES = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)  # exponents of MS-SSIM, finest first
SMALLEST_OF_SCALES = (WINDOW_PIXELS - 1) * 2 ** (len(SCALES) - 1) + 1  # pixels: the window fits at the coarsest scale


def squared_errors(picture: Picture, truth: Picture) -> NDArray[np.int32]:
    """Squared difference of two 8-bit pictures ``[H, W, 3]``, summed over channels, ``[H, W]``, exactly."""
    squares = np.square(np.subtract(picture, truth, dtype=np.int16), dtype=np.int32)
    return squares[..., 0] + squares[..., 1] + squares[..., 2]  # many times faster than a sum over so short an axis


def decibels(error: float) -> float:
    """The PSNR of a mean squared error (full scale 1); 100 dB for no error."""
    return -10.0 * math.log10(error) if error > 0.0 else PSNR_OF_EQUALS


def psnr_of(errors: NDArray[np.int32]) -> float:
    """The PSNR of at least one pixel with these :func:`squared_errors`, dB."""
    return decibels(int(errors.sum(dtype=np.int64)) / (3 * 255**2 * errors.size))


def psnr(picture: Picture, truth: Picture, mask: Mask | None = None) -> float:
    """Peak signal-to-noise ratio of two 8-bit pictures ``[H, W, 3]``, dB, over the channels of the pixels of ``mask``
    ``[H, W]``, of which there is one at least; None for all."""
    errors = squared_errors(picture, truth)
    return psnr_of(errors if mask is None else errors[mask])


def _similarity(a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
    """Luminance, and contrast times structure, of every window that lies in two pictures ``[3, H, W]``."""
    kernel = window(a).expand(15, 1, WINDOW_PIXELS)
    moments = torch.cat([a, b, a * a, b * b, a * b])[None]  # [1, 15, H, W]
    moments = conv2d(moments, kernel[:, :, None, :], groups=15)
    moments = conv2d(moments, kernel[:, :, :, None], groups=15)
    mean_a, mean_b, square_a, square_b, product = moments[0].unflatten(0, (5, 3))
    variances = square_a - mean_a**2 + square_b - mean_b**2
    covariance = product - mean_a * mean_b
    luminance = (2 * mean_a * mean_b + C1) / (mean_a**2 + mean_b**2 + C1)
    return luminance, (2 * covariance + C2) / (variances + C2)


def ms_ssim(picture: Picture, truth: Picture) -> float | None:
    """Structural similarity over five scales (Wang et al., 2003), averaged over channels; None for small pictures.

    Windows and constants as in :func:`ssim`, without padding. Each scale averages 2x2 pixels of the one before; an
    odd side is padded with a line of zeros at its start, as in pytorch-msssim. The result is the product over scales of
    the mean of contrast times structure (at the coarsest scale of SSIM), clamped at 0, to the power of its weight.
    """
    if min(truth.shape[:2]) < SMALLEST_OF_SCALES:
        return None
    a, b = (torch.from_numpy(np.ascontiguousarray(p)).permute(2, 0, 1) / 255.0 for p in (picture, truth))
    product = torch.ones(3)
    for scale, weight in enumerate(SCALES):
        luminance, structure = _similarity(a, b)
        last = scale == len(SCALES) - 1
        product *= (luminance * structure if last else structure).mean((1, 2)).relu() ** weight
        odd = a.shape[1] % 2, a.shape[2] % 2
        a, b = (avg_pool2d(channels, 2, padding=odd) for channels in (a, b))
    return float(product.mean())


def ssim(picture: Picture, truth: Picture, backend: Backend, mask: Mask | None = None) -> float:
    """Mean structural similarity over pixels and channels (Wang et al., 2004), as Gaussian splatting papers report it:
    with zeros beyond the border (``kernels/reference_losses.py``).

    On real pictures all back-ends agree within 1e-5; the C++ one is the nearest to float64. With a ``mask`` ``[H, W]``
    the mean is over its pixels. Both pictures are black in the others, which therefore count as beyond the border.
    """
    image, target = (torch.from_numpy(np.ascontiguousarray(p)).to(backend.device) for p in (picture, truth))
    with torch.no_grad():
        if mask is not None:
            return float(ssim_map(image / 255.0, target / 255.0)[torch.from_numpy(mask).to(backend.device)].mean())
        return float(backend.l1_ssim(image / 255.0, target)[1])


def psnr_affine(picture: Picture, truth: Picture) -> float:
    """PSNR of ``picture`` after its best affine change of colour towards ``truth``, dB."""
    # In torch, because the spinning threads of NumPy's BLAS slowed the next rendering by half (2 cores).
    given, wanted = (
        torch.from_numpy(np.ascontiguousarray(p)).reshape(-1, 3).double() / 255.0 for p in (picture, truth)
    )
    given = torch.cat([given, torch.ones_like(given[:, :1])], dim=1)
    matrix = np.linalg.lstsq((given.T @ given).numpy(), (given.T @ wanted).numpy(), rcond=None)[0]  # [4, 3]
    errors = ((given @ torch.from_numpy(matrix)).clamp_(0.0, 1.0) - wanted).square_()
    return decibels(float(errors.mean()))


@dataclass(frozen=True)
class ChannelFit:
    """A camera's colour response, ``gain * rendering + bias`` per channel (Note [Colour of a camera])."""

    gains: tuple[float, float, float]  # gain of red, green and blue
    biases: tuple[float, float, float]  # bias of red, green and blue, full scale 1


def channel_fit(picture: Picture, truth: Picture) -> ChannelFit:
    """The gain and bias of each channel that minimize the squared error of ``picture`` against ``truth``.

    Both are ``[H, W, 3]`` uint8. A constant channel gets gain 1, because it does not determine one.
    """
    pairs = [_fit_line(picture[..., channel], truth[..., channel]) for channel in range(3)]
    (r, g, b), biases = zip(*pairs, strict=True)
    return ChannelFit((r, g, b), biases)


def _fit_line(values: Picture, targets: Picture) -> tuple[float, float]:
    x, y = values.astype(np.float64), targets.astype(np.float64)
    mean_x, mean_y = float(x.mean()), float(y.mean())
    x -= mean_x
    variance = float(np.square(x).sum())
    gain = float((x * (y - mean_y)).sum()) / variance if variance > 0.0 else 1.0
    return gain, (mean_y - gain * mean_x) / 255.0


def psnr_camera_color(picture: Picture, truth: Picture, fit: ChannelFit) -> float:
    """PSNR, dB, of ``picture`` corrected by ``fit`` and clamped, not rounded."""
    levels = np.arange(256, dtype=np.float64)
    total = 0.0
    for channel, (gain, bias) in enumerate(zip(fit.gains, fit.biases, strict=True)):
        table = np.clip(gain * levels + 255.0 * bias, 0.0, 255.0).astype(np.float32)
        difference = table[picture[..., channel]] - truth[..., channel]
        total += float(np.square(difference).sum(dtype=np.float64))
    return decibels(total / (255.0**2 * truth.size))


def score(
    picture: Picture,
    truth: Picture,
    first: Picture,
    *,
    backend: Backend,
    seconds: float = 0.0,
    color: ChannelFit | None = None,
    mask: Mask | None = None,
    first_mask: Mask | None = None,
) -> Scores:
    """The scores of a rendering against ``truth``.

    Args:
        color: the camera's colour response, fitted to frame 0; None to leave out that score.
        mask: ``[H, W]`` bool, the pixels that count; None for all. Pictures are black in the others.

    Raises:
        CaptureError: the pictures have different sizes.
    """
    for other, what in ((truth, "truth"), (first, "truth of frame 0")):
        if picture.shape != other.shape:
            raise CaptureError(
                f"A rendering of {picture.shape[1]}x{picture.shape[0]} pixels cannot be scored against a {what} of "
                f"{other.shape[1]}x{other.shape[0]}; open the capture at the scale of the reconstruction."
            )
    errors, changed = squared_errors(picture, truth), changed_pixels(truth, first, both(mask, first_mask))
    ssim_score = ssim(picture, truth, backend, mask)
    if mask is not None:
        errors, changed = errors[mask], changed[mask]
        picture, truth = counting(mask, picture, truth)
    moving = int(np.count_nonzero(changed))
    return Scores(
        psnr=psnr_of(errors),
        ssim=ssim_score,
        psnr_affine=psnr_affine(picture, truth),
        psnr_changed=psnr_of(errors[changed]) if moving else None,
        psnr_still=psnr_of(errors[~changed]) if moving < errors.size else None,
        changed_share=moving / errors.size,
        render_seconds=seconds,
        psnr_camera_color=None if color is None else psnr_camera_color(picture, truth, color),
    )


def counting(mask: Mask | None, *pictures: Picture) -> tuple[Picture, ...]:
    """The pixels of each picture ``[H, W, 3]`` that count, as a picture ``[P, 1, 3]``; unchanged without a mask."""
    return pictures if mask is None else tuple(picture[mask][:, None] for picture in pictures)
