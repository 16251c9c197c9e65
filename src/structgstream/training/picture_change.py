# SPDX-License-Identifier: Apache-2.0
"""What two pictures of one camera tell by themselves: nothing here looks at a scene.

So it can be found for the next frame while this one is still being fitted (``lookahead``).
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
    """How a training picture differs from the one before it.

    Args:
        changed: ``[H, W]`` bool, pixels that changed.
        identical: whether the two are equal bit for bit.
        flow: ``[h, w, 6]`` the maps of ``flow_maps.flow_map`` from the picture before to this one, and the picture
            before in 0 ... 1; None where flow was not looked for.
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
    """How each of ``views`` differs from the picture of the same camera in ``before``.

    Args:
        views: of a frame.
        before: of the frame before, in the same order.
        threshold: mean absolute difference of 3 x 3 pixels, in 0 ... 1, above which a pixel has changed.
        reach_pixels: changed pixels are dilated by this many pixels.
        scale: of the maps of flow, in sizes of the pictures.
        backend: what computes.
        flow_from: indices of the views in which flow is looked for.
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
