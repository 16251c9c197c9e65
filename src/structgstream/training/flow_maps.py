# SPDX-License-Identifier: Apache-2.0
"""Optical flow of a training camera as maps to be summed by blending weights."""

import numpy as np
import torch
from torch import Tensor

from structgstream.flow import consistency_mask, dis_search
from structgstream.training.views import area_mean

CONTEXT_PIXELS = 16
"""Margin in pixels around the bounding box of the changed pixels, in which flow is estimated."""


def flow_map(
    first: Tensor,
    second: Tensor,
    changed: Tensor,
    size: tuple[int, int],
    *,
    mask: Tensor | None = None,
    finest_level: int = 1,
) -> Tensor:
    """Flow between two pictures of one camera with confidence c: ``[h, w, 3]``, the maps (c, c flow_x, c flow_y).

    c is the share of consistent pixels (``flow.consistency_mask``), zero outside a box around
    ``changed``.

    Args:
        first: ``[H, W, 3]`` uint8.
        second: ``[H, W, 3]`` uint8.
        changed: ``[H, W]`` bool, where the two differ.
        size: h and w of the maps; flow is in pixels of the pictures.
        mask: ``[H, W]`` bool, pixels that may have confidence; None for all.
        finest_level: of the flow search's pyramid (``flow.dis_search``).
    """
    height, width = changed.shape
    maps = torch.zeros(height, width, 3)
    box = _box(changed)
    if box is not None:
        rows, columns = box
        search = dis_search("capture", refined=False, finest_level=finest_level)
        earlier, later = (np.ascontiguousarray(p[rows, columns].numpy(force=True)) for p in (first, second))
        forward, backward = search(earlier, later), search(later, earlier)
        confidence = consistency_mask(forward, backward).astype(np.float32)[..., None]
        if mask is not None:
            confidence *= mask[rows, columns, None].numpy(force=True)
        maps[rows, columns] = torch.from_numpy(np.concatenate([confidence, confidence * forward], axis=-1))
    small = area_mean(maps.permute(2, 0, 1)[None], size)
    return small[0].permute(1, 2, 0).to(first.device)


def _box(mask: Tensor) -> tuple[slice, slice] | None:
    """Bounding box of the mask ``[H, W]`` with margin; None if it is empty or too small for the flow search."""
    if not mask.any():
        return None
    spans = []
    for axis in (1, 0):
        hit = mask.any(axis).nonzero()[:, 0]
        low, high = int(hit[0]) - CONTEXT_PIXELS, int(hit[-1]) + 1 + CONTEXT_PIXELS
        spans.append(slice(max(0, low), min(mask.shape[1 - axis], high)))
    if min(span.stop - span.start for span in spans) < 2 * CONTEXT_PIXELS:
        return None
    return spans[0], spans[1]
