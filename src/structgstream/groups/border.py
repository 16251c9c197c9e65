# SPDX-License-Identifier: Apache-2.0
"""Anchors at the border of two groups, by renderings of both fits: those that move, or whose mixture fits neither.

A seam blend mixes values of the previous frame with the group's own. On an untextured moving body, or where one fit has
a free Gaussian and the other has anchors, the mixture is wrong although no change is detected there.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from structgstream.cameras import CameraRig, enlargement
from structgstream.kernels.backend import Backend
from structgstream.scene.render import render, to_8bit_image
from structgstream.scene.scene import Scene
from structgstream.training.online.config import MotionConfig
from structgstream.training.online.measure import accumulate, measure, primitive_of, sum_by_primitive
from structgstream.training.online.preprocess import detect_changes
from structgstream.training.online.select import changed_primitives, select_dynamic
from structgstream.training.views import View, area_mean

CAMERAS = 9
"""Training cameras, at equal distances in the rig, for which the frames around a border are drawn."""


def border_cameras(rig: CameraRig) -> tuple[str, ...]:
    """Names of the cameras for which the frames around a border are drawn."""
    return rig.training[:: max(1, len(rig.training) // CAMERAS)]


@dataclass(frozen=True)
class BorderPictures:
    """Renderings of the two frames at a border; at 640 x 360 they take 50 MB.

    Args:
        before: rendering ``[H, W, 3]`` of the last frame of the group before, by name of the :func:`border_cameras`.
        first: rendering ``[H, W, 3]`` of the first frame of the group, by the same names.
    """

    before: Mapping[str, Tensor]
    first: Mapping[str, Tensor]


def draw_border(before: Scene, first: Scene, rig: CameraRig, backend: Backend) -> BorderPictures:
    """Draws the last frame of a group and the first one of the next."""
    names = border_cameras(rig)
    with torch.no_grad():
        then, now = ({name: render(scene, rig[name], backend).image for name in names} for scene in (before, first))
    return BorderPictures(then, now)


def moving_at_border(
    before: Scene,
    first: Scene,
    pictures: BorderPictures,
    rig: CameraRig,
    backend: Backend,
    *,
    earlier: Scene | None = None,
    second: Scene | None = None,
) -> Tensor | None:
    """Mask ``[M]`` of the anchors of ``first`` that move; None if everything changes, as at a cut.

    An anchor moves if the selection of an online frame finds it between the renderings of ``before`` and ``first``,
    or if it changed from ``earlier`` to ``before`` or from ``first`` to ``second``. The second test is needed because
    slow motion, and fast motion of an untextured surface, change the pictures by less than the two fits differ.

    Args:
        before: the last frame of the group before.
        first: the first frame of the group.
        pictures: renderings of these two frames.
        rig: in the units of the scene.
        backend: the compute back-end.
        earlier: the last but one frame of the group before; None if that group has one frame only.
        second: the second frame of the group; None if it has one frame only.
    """
    config = MotionConfig(enabled=True, picture_scale=0.5)
    views, earlier_views = (_as_views(drawn, rig, backend) for drawn in (pictures.first, pictures.before))
    changes = detect_changes(views, earlier_views, config=config, backend=backend)
    measured = measure(first, views, changes, config=config, backend=backend)
    found = select_dynamic(first, measured, config=config, backend=backend)
    if found.scene_cut:
        return None
    moving = found.anchors
    for older, newer in ((earlier, before), (first, second)):
        if older is not None and newer is not None:
            moving = moving | changed_primitives(older, newer)[: len(moving)]
    return moving


def _as_views(drawn: Mapping[str, Tensor], rig: CameraRig, backend: Backend) -> list[View]:
    """Renderings as if they were pictures of their cameras."""
    pictures = ((name, torch.from_numpy(to_8bit_image(image)).to(backend.device)) for name, image in drawn.items())
    return [View(row, rig[name], picture) for row, (name, picture) in enumerate(pictures)]


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
