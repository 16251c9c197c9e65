# SPDX-License-Identifier: Apache-2.0
"""How far cameras stand apart, as the scene sees it, and what that leaves for viewpoints between them.

Note [Spacing]
~~~~~~~~~~~~~~
The angle between neighbours decides, not the number of cameras: 4 of them 32 degrees apart in front of a counter gave
30.1 dB at a new viewpoint, 12 around a dome, 47 degrees apart, 27.5 dB. Wider, hardly anything is matched, and frame 0
explains each camera alone, by screens in front of its lens. The second nearest camera counts, since a pair on one
tripod surrounds nothing, and since a point needs a third ray that confirms it.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from structgstream.cameras import Camera
from structgstream.data.matching import viewing_distance


def camera_spacing(cameras: Mapping[str, Camera]) -> float:
    """Angle in degrees from a camera to its second nearest, the median over the cameras, seen from the scene's middle.

    The middle is the median of the points at ``matching.viewing_distance`` on the optical axes. Of two cameras it is
    the angle between them, of one 180.
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


MEASURED = (
    (11.8, 34.5), (22.8, 32.8), (26.3, 31.6), (31.7, 30.1), (46.9, 27.5), (54.1, 21.3), (71.8, 18.0), (96.0, 16.3)
)  # fmt: skip
"""Spacing in degrees, and PSNR in dB of frame 0 at cameras that were held out, of two captures with 4 to 27 cameras
(lab/notes/scaling.md, Few cameras far apart). At 54 degrees it is the mean of three seeds, which differ by 5 dB."""
SPREAD = 1.15
"""Factor by which cameras may be farther apart, or closer, than their spacing says: two sets of 8 cameras of one dome,
48 and 54 degrees apart, gave 21.9 and, over three seeds, 19 to 24 dB."""
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
        poor: whether new viewpoints may be hardly watchable.
    """

    sentence: str
    poor: bool


def expected_psnr(degrees: float) -> float:
    """PSNR in dB that cameras ``degrees`` apart gave at held-out ones, interpolated between what was measured."""
    apart, psnr = zip(*MEASURED, strict=True)
    return float(np.interp(degrees, apart, psnr))


def expectation(cameras: Mapping[str, Camera]) -> Expectation | None:
    """What is to be expected of the training cameras; None if they are as close as docs/film-it.md asks for."""
    degrees, count = camera_spacing(cameras), len(cameras)
    if degrees <= GOOD_DEGREES:
        return None
    low, high = expected_psnr(degrees * SPREAD), expected_psnr(degrees / SPREAD)
    enough = math.ceil(count * (degrees / GOOD_DEGREES) ** (1.0 / COUNT_EXPONENT))
    closer = {number: degrees * (count / number) ** COUNT_EXPONENT for number in (min(2 * count, enough), enough)}
    better = ", ".join(f"{expected_psnr(apart):.0f} with {number}" for number, apart in closer.items())
    poor = low < WARNING_PSNR
    torn = ", where people and objects may be torn" if poor else ""
    return Expectation(
        f"{count} cameras, about {degrees:.0f} degrees apart: expect {low:.0f} to {high:.0f} dB at viewpoints between "
        f"them{torn} (about {better}); add cameras, or move them closer together.",
        poor,
    )
