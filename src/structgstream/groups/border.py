# SPDX-License-Identifier: Apache-2.0
"""Which anchors move where one group ends and the next begins, from renderings of the two alone."""

from collections.abc import Sequence

import torch
from torch import Tensor

from structgstream.cameras import CameraRig
from structgstream.kernels.backend import Backend
from structgstream.scene.render import render, to_8bit_image
from structgstream.scene.scene import Scene
from structgstream.training.motion import MotionConfig, changed_movers, detect_changes, segment_motion
from structgstream.training.views import View

CAMERAS = 9
"""Training cameras, at equal distances in the rig, for which the frames around a border are drawn."""


def border_cameras(rig: CameraRig) -> tuple[str, ...]:
    """Names of the cameras for which the frames around a border are drawn."""
    return rig.training[:: max(1, len(rig.training) // CAMERAS)]


def moving_at_border(
    before: Scene,
    first: Scene,
    rig: CameraRig,
    backend: Backend,
    *,
    earlier: Scene | None = None,
    second: Scene | None = None,
) -> Tensor | None:
    """Mask ``[M]`` of the anchors of ``first`` that move; None where everything changes, as at a cut.

    An anchor moves if the change gate of an online frame finds it between the renderings of ``before`` and ``first``,
    or if it changed from ``earlier`` to ``before`` or from ``first`` to ``second``: what moves slowly, and the plain
    inside of what moves fast, changes the pictures by less than the two fits differ.

    Args:
        before: the last frame of the group before.
        first: the first frame of the group.
        rig: in the units of the scene.
        backend: the compute back-end.
        earlier: the last but one frame of the group before; None if it has no other.
        second: the second frame of the group; None if it has no other.
    """
    names = border_cameras(rig)
    config = MotionConfig(enabled=True, picture_scale=0.5)
    views = _drawn(first, names, rig, backend)
    changes = detect_changes(views, _drawn(before, names, rig, backend), config=config, backend=backend)
    found = segment_motion(first, views, changes, config=config, backend=backend)
    if found.scene_cut:
        return None
    moving = found.anchors
    for older, newer in ((earlier, before), (first, second)):
        if older is not None and newer is not None:
            moving = moving | changed_movers(older, newer)[: len(moving)]
    return moving


def _drawn(scene: Scene, names: Sequence[str], rig: CameraRig, backend: Backend) -> list[View]:
    """Renderings of ``scene`` as if they were pictures of the cameras ``names``."""
    device = backend.device
    with torch.no_grad():
        pictures = [torch.from_numpy(to_8bit_image(render(scene, rig[name], backend).image)) for name in names]
    return [View(row, rig[name], image.to(device)) for row, (name, image) in enumerate(zip(names, pictures))]
