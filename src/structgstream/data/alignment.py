# SPDX-License-Identifier: Apache-2.0
"""The similarity transform between two estimates of one rig, also for the points of a COLMAP model."""

import logging
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import PurePosixPath

import numpy as np
import torch
from numpy.typing import NDArray

from structgstream.cameras import Camera, CameraRig
from structgstream.data.arrays import Floats
from structgstream.data.calibration import Calibration, PosedCamera
from structgstream.data.lenses import LensCamera


@dataclass(frozen=True)
class Alignment:
    """``aligned = scale * rotation @ point + translation``.

    Args:
        scale: positive.
        rotation: ``[3, 3]``.
        translation: ``[3]``.
    """

    scale: float
    rotation: Floats
    translation: Floats

    def points(self, points: Floats) -> Floats:
        """Points ``[..., 3]``, aligned."""
        return self.scale * points @ self.rotation.T + self.translation

    def camera(self, camera: Camera) -> Camera:
        """A camera that sees the aligned points where ``camera`` sees the points."""
        viewmat = camera.viewmat.clone()
        turned = camera.viewmat[:3, :3] @ torch.from_numpy(self.rotation.T.copy())
        viewmat[:3, :3] = turned
        viewmat[:3, 3] = self.scale * camera.viewmat[:3, 3] - turned @ torch.from_numpy(self.translation)
        return replace(camera, viewmat=viewmat, near=camera.near * self.scale)

    def filmed(self, filmed: LensCamera) -> LensCamera:
        """:meth:`camera` of a camera with a lens."""
        return LensCamera(self.camera(filmed.camera), filmed.lens)


def alignment(theirs: Mapping[str, Floats], ours: Mapping[str, Floats]) -> Alignment:
    """The similarity from ``theirs`` to ``ours``, world-to-camera matrices ``[4, 4]`` of the same names.

    The rotation is that of the cameras' axes, since positions alone do not give it when cameras stand in a line; scale
    and translation are least squares of the positions (Umeyama, PAMI 1991). Cameras that all stand at one place leave
    the scale at 1.
    """
    turns = sum(ours[name][:3, :3].T @ theirs[name][:3, :3] for name in theirs)
    u, _, vh = np.linalg.svd(turns)
    rotation = u @ np.diag([1, 1, np.linalg.det(u @ vh)]) @ vh
    from_, to = (np.array([_center(poses[name]) for name in theirs]) for poses in (theirs, ours))
    turned = (from_ - from_.mean(0)) @ rotation.T
    spread = float((turned**2).sum())
    scale = float((turned * (to - to.mean(0))).sum() / spread) if spread > 0 else 1.0
    return Alignment(scale, rotation, to.mean(0) - scale * rotation @ from_.mean(0))


def _center(viewmat: Floats) -> Floats:
    return -viewmat[:3, :3].T @ viewmat[:3, 3]


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
