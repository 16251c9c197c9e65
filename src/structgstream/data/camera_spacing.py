# SPDX-License-Identifier: Apache-2.0
"""How far cameras stand apart, as the scene sees it, what that leaves for viewpoints between them, and which camera the
others surround.

Note [Spacing]
~~~~~~~~~~~~~~
The angle between neighbours decides, not the number of cameras: 4 of them 32 degrees apart in front of a counter gave
30.1 dB at a new viewpoint, 12 around a dome, 47 degrees apart, 27.5 dB. Wider, hardly anything is matched, and frame 0
explains each camera alone, by screens in front of its lens. The second nearest camera counts, since a pair on one
tripod surrounds nothing, and since a point needs a third ray that confirms it.

Note [Surrounded]
~~~~~~~~~~~~~~~~~
A held-out camera measures interpolation if others stand on all of its sides, and extrapolation at the rim of the rig.
The measure is the camera's Voronoi cell among the others, in the plane of its picture: the cell is bounded exactly if
the camera lies inside the convex hull of the others, and small if they stand near on all sides (Aurenhammer, ACM
Computing Surveys, 1991). With others at angles ``a`` and distances ``d``, the border of the cell in the direction ``u``
is at half of ``reach(u)``, the least ``d / cos(a - u)``. Three departures make it a measure of rigs:

- Of two opposite directions the farther reach counts for both, so that a twin on one side makes no camera surrounded.
- ``d`` is divided by the cosine of half the angle between both view directions: a camera that looks elsewhere surrounds
  nothing.
- A cell ends at the extent of the rig. In a row of cameras all cells are open upwards and downwards.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from structgstream.cameras import Camera, CameraRig
from structgstream.data.matching import viewing_distance
from structgstream.errors import ConfigError
from structgstream.geometry import Floats


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
        sentence: number and spacing of the cameras, and the PSNR to expect, also with more cameras; or that they look
            away from each other.
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
    if _look_apart(cameras):
        return Expectation(
            f"{count} cameras that look away from each other: neighbours see the same from nearly the same side, so "
            "depth is uncertain, and viewpoints between them may be hardly watchable; no such rig was measured.",
            poor=True,
        )
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


def _look_apart(cameras: Mapping[str, Camera]) -> bool:
    """Whether optical axes diverge where cameras stand apart, as in a rig in the middle of a room."""
    centers = np.stack([camera.center.numpy() for camera in cameras.values()])
    axes = np.stack([camera.viewmat.numpy()[2, :3] for camera in cameras.values()])
    apart, turned = centers[:, None] - centers, axes[:, None] - axes
    lengths = np.linalg.norm(apart, axis=2) * np.linalg.norm(turned, axis=2)
    return bool((apart * turned).sum() > 0.5 * lengths.sum())


DIRECTIONS = 360
ALIKE = 1.5
"""Cells whose areas differ by less are alike, as cameras are placed by hand; the most central of them is taken."""


def best_surrounded(rig: CameraRig) -> str:
    """The camera with the smallest cell among the others; see Note [Surrounded].

    Among cells of half as much again, the one with the least mean distance to the others, then the first of the rig.
    The rig's own held-out set plays no part.

    Raises:
        ConfigError: fewer than three cameras, of which none can be spared.
    """
    names = list(rig)
    if len(names) < 3:
        raise ConfigError(
            f"A camera can be held out of three or more, and the rig has {len(names)} ({', '.join(names)}); "
            "film with another camera, or hold out none."
        )
    centers = rig.centers.numpy()
    apart = np.linalg.norm(centers[:, None] - centers, axis=-1)
    extent = float(apart.max())
    if extent == 0:
        return names[0]
    cells = np.array([_cell(*_others(rig, name), most=extent) for name in names])
    away = apart.mean(1) / extent
    alike = np.flatnonzero(cells <= ALIKE * cells.min())
    # Rounded, so that equal cameras do not differ by the machine's last bit.
    return names[min(alike, key=lambda index: (round(float(away[index]), 6), index))]


def _others(rig: CameraRig, name: str) -> tuple[Floats, Floats]:
    """Where the others stand in the plane of a camera's picture: angles in radians and distances, each ``[N]``.

    Cameras that look the other way, or stand on its optical axis, are left out.
    """
    own = rig[name].viewmat.numpy()
    angles, distances = [], []
    for other in rig:
        if other == name:
            continue
        toward = own[:3, :3] @ (rig[other].center.numpy() - rig[name].center.numpy())
        distance = float(np.linalg.norm(toward))
        along = float(own[2, :3] @ rig[other].viewmat.numpy()[2, :3])  # cosine between the view directions
        turned = np.sqrt(max((1 + along) / 2, 0.0))  # of half the angle
        across = float(np.linalg.norm(toward[:2]))
        if turned > 1e-3 and across > 1e-6 * distance:
            angles.append(np.arctan2(toward[1], toward[0]))
            distances.append(distance / turned)
    return np.array(angles), np.array(distances)


def _cell(angles: Floats, distances: Floats, *, most: float) -> float:
    """The area of the symmetric cell that ends at ``most``, in circles of that radius."""
    if not len(angles):
        return 1.0
    directions = np.linspace(0, 2 * np.pi, DIRECTIONS, endpoint=False)
    cosines = np.maximum(np.cos(directions[:, None] - angles), 1e-9)
    reach = np.minimum((distances / cosines).min(1) / most, 1.0)
    return float((np.maximum(reach, np.roll(reach, DIRECTIONS // 2)) ** 2).mean())
