# SPDX-License-Identifier: Apache-2.0
"""How far cameras stand apart, as the scene sees it, and what that leaves for viewpoints between them.

Note [Few cameras]
~~~~~~~~~~~~~~~~~~
The angle between neighbours decides, not the number of cameras: 4 of them 32 degrees apart in front of a counter are
better than 12 around a dome, 47 degrees apart. A camera that few others stand near can be explained alone, by what
only its direction sees. The second nearest camera counts, since a pair on one tripod surrounds nothing, and since a
point needs a third ray that confirms it.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from structgstream.cameras import Camera


def viewing_distance(cameras: Mapping[str, Camera]) -> float:
    """Typical distance from a camera to the scene, estimated from the poses.

    It is the distance to the point nearest to all optical axes, if that lies in front of most cameras; for nearly
    parallel axes (a flat forward-facing array) five times the rig's radius.
    """
    centers = np.stack([camera.center.numpy() for camera in cameras.values()])
    axes = np.stack([camera.viewmat.numpy()[2, :3] for camera in cameras.values()])
    projectors = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    focus = np.linalg.lstsq(projectors.sum(0), (projectors @ centers[:, :, None]).sum(0)[:, 0], rcond=1e-6)[0]
    depths = ((focus - centers) * axes).sum(1)
    radius = float(np.linalg.norm(centers - centers.mean(0), axis=1).max())
    distance = float(np.median(depths))
    meets = (depths > 0).mean() > 0.7 and distance < 30 * radius
    return max(distance if meets else 5 * radius, 1e-9)


def camera_spacing(cameras: Mapping[str, Camera]) -> float:
    """Angle in degrees from a camera to its second nearest, the median over the cameras, seen from the scene's middle.

    The middle is the median of the points at :func:`viewing_distance` on the optical axes. Of two cameras it is the
    angle between them, of one 180.
    """
    if len(cameras) < 2:
        return 180.0
    centers = np.stack([camera.center.numpy() for camera in cameras.values()])
    axes = np.stack([camera.viewmat.numpy()[2, :3] for camera in cameras.values()])
    toward = centers - np.median(centers + viewing_distance(cameras) * axes, axis=0)
    toward /= np.maximum(np.linalg.norm(toward, axis=1, keepdims=True), 1e-12)
    angles = np.degrees(np.arccos(np.clip(toward @ toward.T, -1.0, 1.0)))
    np.fill_diagonal(angles, np.inf)
    angles.sort(axis=1)
    return float(np.median(angles[:, min(1, len(cameras) - 2)]))


MANY_CAMERAS, FEW_CAMERAS = 12, 8
NEAR_DEGREES, FAR_DEGREES = 35.0, 50.0


def sparsity(cameras: Mapping[str, Camera]) -> float:
    """How much frame 0 needs against explaining each camera alone, 0 to 1 (Note [Few cameras]).

    It falls from 1 to 0 between :data:`FEW_CAMERAS` and :data:`MANY_CAMERAS` cameras, and between a
    :func:`camera_spacing` of :data:`FAR_DEGREES` and :data:`NEAR_DEGREES`.
    """
    few = (MANY_CAMERAS - len(cameras)) / (MANY_CAMERAS - FEW_CAMERAS)
    if few <= 0.0:
        return 0.0
    far = (camera_spacing(cameras) - NEAR_DEGREES) / (FAR_DEGREES - NEAR_DEGREES)
    return min(few, 1.0) * min(max(far, 0.0), 1.0)


def neighbor_distance(cameras: Mapping[str, Camera]) -> float:
    """Distance between cameras that are :func:`camera_spacing` apart, at :func:`viewing_distance` of the scene."""
    return 2.0 * viewing_distance(cameras) * math.sin(math.radians(camera_spacing(cameras)) / 2.0)


MEASURED = ((12.0, 34.3), (26.0, 31.0), (32.0, 30.0), (47.0, 25.0), (54.0, 22.5), (72.0, 18.0), (96.0, 16.5))
"""Spacing in degrees, and PSNR in dB of frame 0 at cameras that were held out, of two captures with 4 to 27 cameras
(lab/notes/scaling.md, Fewer cameras)."""
GOOD_DEGREES = 20.0
"""What docs/film-it.md asks for: nothing is said of cameras that are closer."""
WARNING_PSNR = 25.0
"""dB; below, people between the cameras are blurred or torn."""
COUNT_EXPONENT = 0.7
"""Spacing falls with this power of the number of cameras around the same scene, measured: 0.5 on a sphere, 1 in a
row."""


@dataclass(frozen=True)
class Expectation:
    """What a rig may give at viewpoints between its cameras.

    Args:
        sentence: number and spacing of the cameras, and the PSNR to expect, also with more cameras.
        psnr: dB.
    """

    sentence: str
    psnr: float

    @property
    def poor(self) -> bool:
        """Whether new viewpoints will be hardly watchable."""
        return self.psnr < WARNING_PSNR


def expected_psnr(degrees: float) -> float:
    """PSNR in dB that cameras ``degrees`` apart gave at held-out ones, interpolated between what was measured."""
    return float(np.interp(degrees, *zip(*MEASURED, strict=True)))


def expectation(cameras: Mapping[str, Camera]) -> Expectation | None:
    """What is to be expected of the training cameras; None if they are as close as docs/film-it.md asks for."""
    degrees, count = camera_spacing(cameras), len(cameras)
    if degrees <= GOOD_DEGREES:
        return None
    psnr = expected_psnr(degrees)
    enough = math.ceil(count * (degrees / GOOD_DEGREES) ** (1.0 / COUNT_EXPONENT))
    closer = {number: degrees * (count / number) ** COUNT_EXPONENT for number in (min(2 * count, enough), enough)}
    better = ", ".join(f"{expected_psnr(apart):.0f} with {number}" for number, apart in closer.items())
    torn = ", where people and objects are torn" if psnr < WARNING_PSNR else ""
    return Expectation(
        f"{count} cameras, about {degrees:.0f} degrees apart: expect about {psnr:.0f} dB at viewpoints between "
        f"them{torn} ({better}); add cameras, or move them closer together.",
        psnr,
    )
