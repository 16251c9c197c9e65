# SPDX-License-Identifier: Apache-2.0
"""Matches between cameras whose poses are known, well or roughly."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from structgstream.data.arrays import Floats
from structgstream.data.lenses import LensCamera
from structgstream.data.matching import Pair
from structgstream.preparation.calibration.keypoints import Keypoints


def camera_rays(filmed: LensCamera, pixels: Floats) -> Floats:
    """Unit directions ``[S, 3]`` in the world of pixels as filmed; NaN where the lens shows nothing."""
    flat = filmed.to_normalized(pixels)
    rays = np.concatenate([flat, np.ones((len(flat), 1))], 1) @ filmed.camera.viewmat[:3, :3].numpy()
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def epipolar_angles(cameras: tuple[LensCamera, LensCamera], rays: tuple[Floats, Floats]) -> Floats:
    """Angle ``[S]`` in radians of each pair of rays to their epipolar plane, the larger one of the two cameras.

    Rays that meet behind the cameras count as being a right angle off.
    """
    base = (cameras[1].camera.center - cameras[0].camera.center).numpy()
    length = np.linalg.norm(base)
    if length == 0:
        return np.arccos(np.clip((rays[0] * rays[1]).sum(1), -1, 1))
    base = base / length
    volume = np.abs((np.cross(base, rays[0]) * rays[1]).sum(1))
    widest = [np.linalg.norm(np.cross(base, ray), axis=1) for ray in rays]
    angles = np.arcsin(np.clip(volume / np.maximum(np.minimum(*widest), 1e-12), 0, 1))
    # In the epipolar plane the two rays turn towards each other, unless they meet behind.
    ahead = (rays[0] @ base) - (rays[1] @ base) > -1e-3
    return np.where(ahead, angles, np.pi / 2)


def agreeing_matches(
    keypoints: Mapping[str, Keypoints],
    matches: Mapping[Pair, NDArray[np.uint32]],
    cameras: Mapping[str, LensCamera],
    *,
    degrees: float,
) -> dict[Pair, NDArray[np.uint32]]:
    """The matches whose rays pass within ``degrees`` of their epipolar plane."""
    rays = {name: camera_rays(cameras[name], keypoints[name].pixels) for name in cameras}
    found = {}
    for (one, two), pairs in matches.items():
        angles = epipolar_angles((cameras[one], cameras[two]), (rays[one][pairs[:, 0]], rays[two][pairs[:, 1]]))
        found[one, two] = pairs[angles < np.radians(degrees)]
    return found


def epipolar_pixels(
    keypoints: Mapping[str, Keypoints],
    matches: Mapping[Pair, NDArray[np.uint32]],
    cameras: Mapping[str, LensCamera],
) -> dict[Pair, Floats]:
    """Distance of each match to its epipolar plane, in pixels of the longer of the two focal lengths."""
    rays = {name: camera_rays(cameras[name], keypoints[name].pixels) for name in cameras}
    found = {}
    for (one, two), pairs in matches.items():
        focal = max(float(cameras[name].camera.K[0, 0]) for name in (one, two))
        found[one, two] = focal * epipolar_angles(
            (cameras[one], cameras[two]), (rays[one][pairs[:, 0]], rays[two][pairs[:, 1]])
        )
    return found
