# SPDX-License-Identifier: Apache-2.0
"""Scores at other sizes than that of training, because a player shows streams at the size of its screen."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
import torch

from structgstream.cameras import Camera
from structgstream.data.source import FrameSource, select_cameras
from structgstream.errors import CaptureError
from structgstream.evaluation.metrics import (
    Mask,
    Picture,
    blackened,
    decibels,
    masked_ssim,
    mean_of_squares,
    squared_errors,
    ssim,
)
from structgstream.evaluation.pictures import block_mask, block_means, spread_indices
from structgstream.frames import MultiViewFrame
from structgstream.kernels.backend import Backend
from structgstream.scene.render import Drawable, render, to_8bit_image

STORED_FRAMES, STORED_SHARE = 5, 4
"""At most five frames, and at most one in four, are scored at the stored size: twice the size has four times the
pixels."""


def halved(camera: Camera) -> Camera:
    """The camera of a picture at exactly half the size, without a last row or column that is odd."""
    half = torch.diag(torch.tensor([0.5, 0.5, 1.0], dtype=torch.float64))
    return replace(camera, K=half @ camera.K, width=camera.width // 2, height=camera.height // 2)


def half_scores(
    scene: Drawable, camera: Camera, truth: Picture, *, backend: Backend, mask: Mask | None = None
) -> dict[str, float | None]:
    """PSNR and SSIM, by their names in ``Scores``, of a rendering at half size against the area mean of the truth.

    Args:
        camera: camera of the whole picture, or the result of :func:`halved` if the caller has it; scene units.
        truth: the camera's picture ``[H, W, 3]``, black outside ``mask``.
        mask: ``[H, W]``, the pixels that count; None for all.
    """
    small = None if mask is None else block_mask(mask, 2)
    psnr, similarity = _scores(scene, camera, block_means(truth, 2), small, backend)
    return {"psnr_half": psnr, "ssim_half": similarity}


@dataclass
class StoredSize:
    """Scores at the size of the capture's stored pictures, which are larger than those that a stream was made from."""

    source: FrameSource  # the capture at that size, the same frames
    views: Mapping[str, Camera]  # cameras of the stream by name, scene units
    backend: Backend
    frames: frozenset[int]  # numbers of the scored frames
    _frame: tuple[int, MultiViewFrame] | None = field(default=None, init=False)

    def scores(self, camera: str, scene: Drawable, *, index: int) -> dict[str, float | None]:
        """PSNR and SSIM by their names in ``Scores``; empty for frames that are not scored.

        Raises:
            CaptureError: the stored picture does not exist any more.
        """
        if index not in self.frames:
            return {}
        if self._frame is None or self._frame[0] != index:
            self._frame = index, next(self.source.frames(index))
        truth, mask = self._frame[1].images.get(camera), self._frame[1].masks.get(camera)
        if truth is None:
            raise CaptureError(
                f"The stored picture of camera {camera!r} in frame {index} of {self.source.name} has gone."
            )
        view = self.views[camera].resized(truth.shape[1], truth.shape[0])
        psnr, similarity = _scores(scene, view, blackened(truth, mask), mask, self.backend)
        return {"psnr_stored": psnr, "ssim_stored": similarity}


def stored_size(source: FrameSource, views: Mapping[str, Camera], *, backend: Backend, frames: int) -> StoredSize:
    """Scores at the size of ``source``, for evenly spread frames among the first ``frames``."""
    count = max(1, min(STORED_FRAMES, frames // STORED_SHARE))
    chosen = frozenset(spread_indices(frames, count) if count > 1 else [frames - 1])
    return StoredSize(select_cameras(source, tuple(views)), views, backend, chosen)


def _scores(
    scene: Drawable, camera: Camera, truth: Picture, mask: Mask | None, backend: Backend
) -> tuple[float | None, float | None]:
    if not truth.size or (mask is not None and not mask.any()):
        return None, None
    picture = blackened(to_8bit_image(render(scene, camera, backend).image), mask)
    errors = squared_errors(picture, truth)
    errors = errors if mask is None else errors[mask]
    similarity = ssim(picture, truth, backend) if mask is None else masked_ssim(picture, truth, mask)
    return decibels(mean_of_squares(int(errors.sum(dtype=np.int64)), errors.size)), similarity
