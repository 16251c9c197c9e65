# SPDX-License-Identifier: Apache-2.0
"""Changed pixels and optical flow between two pictures of one camera, independent of the scene.

They can therefore be computed for the next frame while one is fitted (``lookahead``).
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from structgstream.kernels.backend import Backend
from structgstream.training.flow_maps import flow_map
from structgstream.training.views import View


@dataclass(frozen=True)
class PictureChange:
    """Change of a training picture since the previous one.

    Args:
        changed: ``[H, W]`` bool, dilated mask of the changed pixels.
        identical: whether the two are equal bit for bit.
        flow: ``[h, w, 6]`` the maps of ``flow_maps.flow_map`` from the previous picture to this one, and the previous
            picture in 0 ... 1; None if flow was not estimated.
    """

    changed: Tensor
    identical: bool
    flow: Tensor | None = None


def detect_picture_changes(
    views: Sequence[View],
    before: Sequence[View],
    *,
    threshold: float,
    reach_pixels: int,
    scale: float,
    backend: Backend,
    flow_from: Collection[int] = (),
) -> list[PictureChange]:
    """Change of each of ``views`` since the picture of the same camera in ``before``.

    Args:
        views: of a frame.
        before: of the previous frame, in the same order.
        threshold: mean absolute difference of 3 x 3 pixels, in 0 ... 1, above which a pixel has changed.
        reach_pixels: changed pixels are dilated by this many pixels.
        scale: of the maps of flow, relative to the pictures.
        backend: the compute back-end.
        flow_from: indices of the views in which flow is estimated.
    """
    changes = []
    with torch.no_grad():
        for view, last in zip(views, before, strict=True):
            changed = backend.changed_pixels(last.image, view.image, threshold=threshold, reach_pixels=reach_pixels)
            small, flow = view.reduced(scale).camera, None
            if view.index in flow_from:
                maps = flow_map(last.image, view.image, changed, (small.height, small.width))
                flow = torch.cat([maps, last.reduced(scale).colors], dim=-1)
            changes.append(PictureChange(changed, torch.equal(last.image, view.image), flow))
    return changes
