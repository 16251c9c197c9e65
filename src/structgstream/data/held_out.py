# SPDX-License-Identifier: Apache-2.0
"""Chooses the camera to hold out of a capture that states none: the one best surrounded by others.

Note [Surrounded]
~~~~~~~~~~~~~~~~~
A held-out camera measures interpolation if others stand on all of its sides, and extrapolation at the rim of the rig.
The measure is the camera's Voronoi cell among the others, in the plane of its picture: the cell is bounded exactly if
the camera lies inside the convex hull of the others, and small if they stand near on all sides (Aurenhammer, Voronoi
diagrams, ACM Computing Surveys, 1991; Sibson's natural neighbours, 1981, are the cell's). With others at angles ``a``
and distances ``d``, the border of the cell in the direction ``u`` is at half of ``reach(u)``, the least
``d / cos(a - u)``. Three departures make it a measure of rigs:

- Of two opposite directions the farther reach counts for both, so that a twin on one side makes no camera surrounded.
- A camera that looks elsewhere surrounds nothing: ``d`` is divided by the cosine of half the angle between both view
  directions, so that neighbours count nearly whole and opposite ones not at all.
- A cell ends at the extent of the rig. In a row of cameras all cells are open upwards and downwards, and those of its
  ends in all directions.
"""

import numpy as np

from structgstream.cameras import CameraRig
from structgstream.data.arrays import Floats
from structgstream.errors import ConfigError

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
    extent = float(np.linalg.norm(centers[:, None] - centers, axis=-1).max())
    if extent == 0:
        return names[0]
    cells = np.array([_cell(*_others(rig, name), most=extent) for name in names])
    away = np.linalg.norm(centers[:, None] - centers, axis=-1).mean(1) / extent
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
