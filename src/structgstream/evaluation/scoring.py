# SPDX-License-Identifier: Apache-2.0
"""The scores of a picture: over all its pixels, and over those that have changed since frame 0."""

import numpy as np
from numpy.typing import NDArray

from structgstream.errors import CaptureError
from structgstream.evaluation.affine import ChannelFit, psnr_affine, psnr_camera_color
from structgstream.evaluation.metrics import (
    both,
    changed_pixels,
    decibels,
    masked_ssim,
    mean_of_squares,
    squared_errors,
    ssim,
)
from structgstream.evaluation.report import Scores
from structgstream.kernels.backend import Backend

Picture = NDArray[np.uint8]
Mask = NDArray[np.bool_]


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
        picture: the rendering.
        truth: the camera's picture.
        first: the camera's picture of frame 0.
        backend: computes SSIM.
        seconds: duration of the rendering.
        color: the camera's colour response, fitted to frame 0; None to leave out that score.
        mask: ``[H, W]`` bool, the pixels that count; None for all. Pictures are black in the others.
        first_mask: mask of ``first``.

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
    ssim_score = ssim(picture, truth, backend) if mask is None else masked_ssim(picture, truth, mask)
    if mask is not None:
        errors, changed = errors[mask], changed[mask]
        picture, truth = counting(mask, picture, truth)
    total, moving = int(errors.sum(dtype=np.int64)), int(np.count_nonzero(changed))
    in_changed = int(np.sum(errors, where=changed, dtype=np.int64))
    return Scores(
        psnr=decibels(mean_of_squares(total, errors.size)),
        ssim=ssim_score,
        psnr_affine=psnr_affine(picture, truth),
        psnr_changed=decibels(mean_of_squares(in_changed, moving)) if moving else None,
        psnr_still=decibels(mean_of_squares(total - in_changed, errors.size - moving))
        if moving < errors.size
        else None,
        changed_share=moving / errors.size,
        render_seconds=seconds,
        psnr_camera_color=None if color is None else psnr_camera_color(picture, truth, color),
    )


def counting(mask: Mask | None, *pictures: Picture) -> tuple[Picture, ...]:
    """The pixels of each picture ``[H, W, 3]`` that count, as a picture ``[P, 1, 3]``; unchanged without a mask."""
    return pictures if mask is None else tuple(picture[mask][:, None] for picture in pictures)
