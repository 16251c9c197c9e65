# SPDX-License-Identifier: Apache-2.0
"""Changed pixels and optical flow between two pictures of one camera, independent of the scene.

They can therefore be computed for the next frame while one is fitted (``lookahead``).
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from structgstream.kernels.backend import Backend
from structgstream.training.flow_maps import USUAL_FLOW, FlowConfig, flow_map
from structgstream.training.views import View, blackened, mean_of_counting

REPEATED_LEVELS = 0.2
"""Mean absolute difference, in levels of 255, below which a picture without a changed pixel is the last one once more.

A frozen picture that is encoded again differs by up to 0.16 (H.264, rate factors 6 and 23, from the second repetition
on); the noise of a camera alone by more: at least 1.2 in every camera of basketball, 2.5 in counter."""


@dataclass(frozen=True)
class PictureChange:
    """Change of a training picture since the previous one.

    Args:
        changed: ``[H, W]`` bool, dilated mask of the changed pixels.
        repeated: whether it is the previous picture once more, equal or encoded again: a frozen camera's.
        flow: ``[h, w, 6]`` the maps of ``flow_maps.flow_map`` from the previous picture to this one, and the previous
            picture in 0 ... 1; None if flow was not estimated.
        far_boxes: number of boxes in which large motion was searched for (``flow_maps.FlowMaps``).
    """

    changed: Tensor
    repeated: bool
    flow: Tensor | None = None
    far_boxes: int = 0


def detect_picture_changes(
    views: Sequence[View],
    before: Sequence[View],
    *,
    threshold: float,
    reach_pixels: int,
    scale: float,
    backend: Backend,
    flow_from: Collection[int] = (),
    flow: FlowConfig = USUAL_FLOW,
) -> list[PictureChange | None]:
    """Change of each of ``views`` since the picture of the same camera in ``before``; None if that has none.

    A camera that was absent is not compared with an older picture: what changed since then is in the scene already.
    Pixels that either picture leaves out have not changed, and their flow has no confidence.

    Args:
        views: of a frame.
        before: of the previous frame.
        threshold: mean absolute difference of 3 x 3 pixels, in 0 ... 1, above which a pixel has changed.
        reach_pixels: changed pixels are dilated by this many pixels of a picture of the reference size.
        scale: of the maps of flow (``View.evidence``).
        backend: the compute back-end.
        flow_from: indices of the views in which flow is estimated.
        flow: how it is searched.
    """
    changes: list[PictureChange | None] = []
    earlier = {last.index: last for last in before}
    with torch.no_grad():
        for view in views:
            last = earlier.get(view.index)
            if last is None:
                changes.append(None)
                continue
            both = _both(view.mask, last.mask)
            then, now = blackened(last.image, both), blackened(view.image, both)
            reach = round(reach_pixels * view.enlargement)
            changed = backend.changed_pixels(then, now, threshold=threshold, reach_pixels=reach)
            changed = changed if both is None else changed & both
            small, found, far_boxes = view.evidence(scale).camera, None, 0
            if view.index in flow_from:
                size = (small.height, small.width)
                estimated = flow_map(then, now, changed, size, mask=both, config=flow, backend=backend)
                found, far_boxes = torch.cat([estimated.maps, last.evidence(scale).colors], dim=-1), estimated.far_boxes
            changes.append(PictureChange(changed, _is_repeated(then, now, changed, both), found, far_boxes))
    return changes


def _is_repeated(then: Tensor, now: Tensor, changed: Tensor, mask: Tensor | None) -> bool:
    """Whether ``now`` is ``then`` once more; ``changed`` as in :class:`PictureChange`, ``mask`` the pixels of both."""
    if changed.any():
        return False
    levels = (now.int() - then.int()).abs().float().mean(-1)
    return float(mean_of_counting(levels, mask)) < REPEATED_LEVELS


def _both(mask: Tensor | None, other: Tensor | None) -> Tensor | None:
    """Pixels of both masks; None for all."""
    if mask is None or other is None:
        return other if mask is None else mask
    return mask & other
