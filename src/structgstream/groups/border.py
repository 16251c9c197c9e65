# SPDX-License-Identifier: Apache-2.0
"""Selection of the anchors that move at the border of two groups, from renderings of both."""

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from structgstream.cameras import CameraRig
from structgstream.kernels.backend import Backend
from structgstream.scene.render import render, to_8bit_image
from structgstream.scene.scene import Scene
from structgstream.training.online.config import MotionConfig
from structgstream.training.online.measure import measure
from structgstream.training.online.preprocess import detect_changes
from structgstream.training.online.select import changed_primitives, select_dynamic
from structgstream.training.views import View

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
