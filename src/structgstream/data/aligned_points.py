# SPDX-License-Identifier: Apache-2.0
"""Points of a COLMAP model of the same cameras, transformed to the rig's coordinates."""

import logging
from pathlib import PurePosixPath

import numpy as np
from numpy.typing import NDArray

from structgstream.cameras import CameraRig
from structgstream.data.alignment import alignment
from structgstream.data.posed import Calibration, PosedCamera

log = logging.getLogger(__name__)

MIN_CAMERAS = 3
MAX_OFF = 0.03
"""Largest residual of a camera position after alignment, as a share of the rig's extent."""


def aligned_points(model: Calibration, rig: CameraRig) -> NDArray[np.float64] | None:
    """The points ``[P, 3]`` of ``model`` in the coordinates of ``rig``, by the similarity that aligns its cameras.

    None, with a warning, if too few cameras match by name or their positions do not agree.
    """
    if model.points is None:
        return None
    found = _common(model, rig)
    if len(found) < MIN_CAMERAS:
        log.warning(
            "%s has %d cameras of the rig by name; its points are not used. Its pictures need the cameras' names.",
            model.where, len(found),
        )  # fmt: skip
        return None
    fitted = alignment(
        {name: posed.viewmat for name, posed in found.items()}, {name: rig[name].viewmat.numpy() for name in found}
    )
    theirs = np.array([posed.center for posed in found.values()])
    ours = np.array([rig[name].center.numpy() for name in found])
    off = np.linalg.norm(fitted.points(theirs) - ours, axis=1).max() / np.linalg.norm(np.ptp(ours, axis=0))
    if not off <= MAX_OFF:
        log.warning(
            "The cameras of %s lie up to %.0f %% of the rig's extent away from the rig's; its points are not used.",
            model.where, 100 * off,
        )  # fmt: skip
        return None
    return fitted.points(model.points)


def _common(model: Calibration, rig: CameraRig) -> dict[str, PosedCamera]:
    """A pose of the model for each camera of the rig whose name is a part of a picture's."""
    found: dict[str, PosedCamera] = {}
    for posed in model.cameras:
        parts = PurePosixPath(posed.name).with_suffix("").parts
        if (name := next((part for part in parts if part in rig.cameras), None)) is not None:
            found.setdefault(name, posed)
    return found
