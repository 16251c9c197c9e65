# SPDX-License-Identifier: Apache-2.0
"""Anchors of two fits that together show what neither fit shows.

A seam blend mixes values of the frame before with the group's own. On an untextured moving body, or where one fit has a
free Gaussian and the other has anchors, the mixture is wrong although no change is detected there.
"""

import torch
from torch import Tensor

from structgstream.cameras import CameraRig, enlargement
from structgstream.groups.border import BorderPictures
from structgstream.kernels.backend import Backend
from structgstream.scene.render import render
from structgstream.scene.scene import Scene
from structgstream.training.online.measure import accumulate, primitive_of, sum_by_primitive
from structgstream.training.views import area_mean

TOLERANCE = 3.0 / 255.0
"""A pixel may be so far outside the range of the two fits. A smaller tolerance adds flicker without a gain
(lab/notes/groups-measured.md)."""
MIN_EXCESS = 1.0 / 255.0
"""An anchor is a visible mixture if the mean distance beyond the tolerance, over the pixels it covers, reaches this."""
MIN_PIXELS = 0.5
"""Anchors that cover fewer pixels of the reduced pictures do not count."""
_SCALE = 0.5  # relative to pictures of the reference size


def visible_mixtures(mixed: Scene, pictures: BorderPictures, rig: CameraRig, backend: Backend) -> Tensor:
    """Mask ``[M]`` of the anchors of ``mixed`` that cover pixels that differ from both frames of the border.

    A pixel may have any colour between those of the two.

    Args:
        mixed: the group's first frame, blended.
        pictures: renderings of the last frame of the group before and of the group's own first frame.
        rig: in the units of the scene.
        backend: the compute back-end.
    """
    folded, count = mixed.with_folded_appearance(), len(mixed.anchors)
    sums = torch.zeros(count, 2).to(mixed.anchors.positions)
    with torch.no_grad():
        for name in pictures.first:
            camera = rig[name]
            small = camera.scaled(_SCALE / enlargement(camera.width, camera.height))
            shown = render(mixed, camera, backend).image
            excess = _excess(shown, pictures.before[name], pictures.first[name])
            excess = area_mean(excess[None, None], (small.height, small.width))
            gaussians = folded.gaussians(small, backend)
            maps = torch.stack([torch.ones_like(excess[0, 0]), excess[0, 0]], dim=-1)
            of_gaussians = accumulate(gaussians, small, maps, backend)
            sums += sum_by_primitive(of_gaussians, primitive_of(gaussians, folded), folded)[:count]
    covered = sums[:, 0]
    return (covered > MIN_PIXELS) & (sums[:, 1] > MIN_EXCESS * covered)


def _excess(mixed: Tensor, before: Tensor, first: Tensor) -> Tensor:
    """Distance ``[H, W]`` of each pixel of ``mixed`` ``[H, W, 3]`` beyond the tolerance, mean over channels."""
    then, own, shown = (image.clamp(0.0, 1.0) for image in (before, first, mixed))
    allowed = shown.clamp(torch.minimum(then, own), torch.maximum(then, own))
    return ((shown - allowed).abs().mean(-1) - TOLERANCE).clamp(min=0.0)
