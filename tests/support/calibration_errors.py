# SPDX-License-Identifier: Apache-2.0
"""How far one calibration of a rig is from another, after the similarity between them."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from structgstream.cameras import CameraRig, rig_radius
from structgstream.data.lenses import LensCamera
from structgstream.preparation.calibration.solved import rig_alignment

GRID = 33


@dataclass(frozen=True)
class CameraError:
    """Errors of one camera.

    Args:
        rotation_degrees: angle between the two orientations.
        position_percent: distance between the positions, of the rig's radius.
        focal_percent: difference of the mean focal lengths; positive when it is estimated too long.
        lens_pixels: root mean square over the picture of the distance between where the two put the same ray, after
            the rotation that brings them closest: what is wrong with focal length, principal point and distortion
            and is not made up for by the pose.
    """

    rotation_degrees: float
    position_percent: float
    focal_percent: float
    lens_pixels: float


def calibration_errors(
    estimated: Mapping[str, LensCamera], reference: Mapping[str, LensCamera]
) -> dict[str, CameraError]:
    """Errors of each camera of ``estimated`` that ``reference`` has, after :func:`rig_alignment`.

    Raises:
        CalibrationError: fewer than two cameras in common.
    """
    fitted = rig_alignment(estimated, reference)
    radius = radius_of(reference)
    found = {}
    for name, filmed in estimated.items():
        if name not in reference:
            continue
        ours, theirs = fitted.filmed(filmed).camera, reference[name].camera
        turn = (ours.viewmat[:3, :3] @ theirs.viewmat[:3, :3].T).numpy()
        found[name] = CameraError(
            float(np.degrees(Rotation.from_matrix(turn).magnitude())),
            100 * float((ours.center - theirs.center).norm()) / radius,
            100 * (_focal(filmed) / _focal(reference[name]) - 1),
            lens_difference(filmed, reference[name]),
        )
    return found


def radius_of(rig: Mapping[str, LensCamera]) -> float:
    """The largest distance of a camera from the mean of all."""
    return rig_radius(CameraRig({name: filmed.camera for name, filmed in rig.items()}))


def lens_difference(estimated: LensCamera, reference: LensCamera) -> float:
    """``lens_pixels`` of :class:`CameraError`; poses are not read. nan if no ray is seen by both."""
    camera = reference.camera
    across, down = np.meshgrid(np.linspace(0, camera.width, GRID), np.linspace(0, camera.height, GRID))
    pixels = np.stack([across.ravel(), down.ravel()], 1)
    ours, theirs = estimated.to_normalized(pixels), reference.to_normalized(pixels)
    both = np.isfinite(ours).all(1) & np.isfinite(theirs).all(1)
    if not both.any():
        return float("nan")
    to, start = _directions(ours[both]), _directions(theirs[both])
    u, _, vh = np.linalg.svd(to.T @ start)
    turned = start @ (u @ np.diag([1, 1, np.linalg.det(u @ vh)]) @ vh).T
    ahead = turned[:, 2] > 0
    moved = estimated.to_pixels(turned[ahead, :2] / turned[ahead, 2:]) - pixels[both][ahead]
    return float(np.sqrt(np.nanmean((moved**2).sum(1))))


def _directions(points: NDArray[np.float64]) -> NDArray[np.float64]:
    rays = np.concatenate([points, np.ones((len(points), 1))], 1)
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def _focal(filmed: LensCamera) -> float:
    return float(filmed.camera.K[0, 0] + filmed.camera.K[1, 1]) / 2
