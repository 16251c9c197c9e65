# SPDX-License-Identifier: Apache-2.0
"""The cameras of each clip: a two-row arc, and camera 0 in its middle as the held-out view."""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

FPS, FRAMES = 30, 12
FIELD_OF_VIEW_DEGREES = 52.0


@dataclass(frozen=True)
class View:
    """A pinhole camera: eye (metres), ``K [3, 3]`` (pixels), ``viewmat [4, 4]`` (world to camera, OpenCV)."""

    name: str
    eye: NDArray[np.float64]
    K: NDArray[np.float64]
    viewmat: NDArray[np.float64]


def intrinsics(width: int, height: int) -> NDArray[np.float64]:
    """K for square pixels and a centred principal point, with the top-left pixel's centre at (0.5, 0.5)."""
    focal = width / 2 / math.tan(math.radians(FIELD_OF_VIEW_DEGREES) / 2)
    return np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])


@dataclass(frozen=True)
class Rig:
    """Cameras around a point, all at one distance from it; nothing is nearer to one of them than ``near_metres``."""

    target: tuple[float, float, float]
    radius_metres: float
    near_metres: float
    # (azimuth, elevation) in degrees about the target; azimuth 0 looks along +y
    directions: tuple[tuple[float, float], ...]
    width: int = 320
    height: int = 240

    def views(self) -> list[View]:
        """The cameras in the order of their numbers."""
        out = []
        target = np.array(self.target)
        for number, (azimuth, elevation) in enumerate(np.deg2rad(self.directions)):
            direction = [
                math.sin(azimuth) * math.cos(elevation),
                -math.cos(azimuth) * math.cos(elevation),
                math.sin(elevation),
            ]
            eye = target + self.radius_metres * np.array(direction)
            forward = (target - eye) / np.linalg.norm(target - eye)
            right = np.cross(forward, [0.0, 0.0, 1.0])
            right /= np.linalg.norm(right)
            viewmat = np.eye(4)
            viewmat[:3, :3] = [right, np.cross(forward, right), forward]
            viewmat[:3, 3] = -viewmat[:3, :3] @ eye
            out.append(View(f"cam{number:02d}", eye, intrinsics(self.width, self.height), viewmat))
        return out


TABLE = Rig(
    target=(0.02, 0.12, 0.155),
    radius_metres=1.5,
    near_metres=0.6,
    directions=(
        (0.0, 17.0),
        (-30.0, 10.0), (-15.0, 10.0), (0.0, 9.0), (15.0, 10.0), (30.0, 10.0),
        (-23.0, 25.0), (-8.0, 26.0), (8.0, 26.0), (23.0, 25.0),
    ),
)  # fmt: skip
RIGS = {
    # The table as 21 cameras see it, as many and of the size of N3DV's.
    "n3dv": replace(
        TABLE,
        directions=(
            (0.0, 17.0),
            *((-31.5 + 7.0 * step, 10.0) for step in range(10)),
            *((-31.5 + 7.0 * step, 24.0) for step in range(10)),
        ),
        width=1352,
        height=1014,
    ),
    "table": TABLE,
    "throw": Rig(
        target=(0.0, 0.0, 0.82),
        radius_metres=3.6,
        near_metres=1.2,
        directions=(
            (0.0, 12.0),
            (-30.0, 7.0), (-15.0, 6.0), (0.0, 5.0), (15.0, 6.0), (30.0, 7.0),
            (-23.0, 20.0), (-8.0, 21.0), (8.0, 21.0), (23.0, 20.0),
        ),
    ),
}  # fmt: skip
