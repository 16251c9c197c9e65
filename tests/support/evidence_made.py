# SPDX-License-Identifier: Apache-2.0
"""Matches of a made rig without pictures: points of the world, projected by the true cameras."""

from collections.abc import Mapping
from dataclasses import replace
from itertools import combinations

import numpy as np
import torch

from structgstream.cameras import Camera
from structgstream.data.matching import inside, project
from structgstream.geometry import Floats
from structgstream.pose_check.tracks import Evidence
from tests.support.takes import ring

Cameras = dict[str, Camera]


def wide_ring(count: int, *, degrees: float = 60.0) -> Cameras:
    """Cameras ``cam0``, ... on an arc of radius 3 around the origin, with pictures of 960x720."""
    return {name: camera.resized(960, 720) for name, camera in ring(count, degrees=degrees).items()}


def scattered(count: int) -> Floats:
    """Points ``[P, 3]`` around the origin that all cameras of :func:`wide_ring` see."""
    return np.random.default_rng(0).uniform(-0.7, 0.7, (count, 3))


def evidence_of(cameras: Mapping[str, Camera], points: Floats, *, noise: float = 0.0) -> Evidence:
    """What ideal matching finds: keypoints ``i`` of all cameras that see a point ``i`` belong together."""
    generator = np.random.default_rng(0)
    keypoints, seen = {}, {}
    for name, camera in cameras.items():
        pixels, depths = project(camera, points)
        seen[name] = inside(camera, pixels, depths, near=0.0)
        keypoints[name] = pixels + noise * generator.normal(size=pixels.shape)
    matches = {}
    for one, two in combinations(cameras, 2):
        both = np.flatnonzero(seen[one] & seen[two])
        matches[one, two] = np.stack([both, both], 1)
    images = {name: np.zeros((camera.height, camera.width, 3), np.uint8) for name, camera in cameras.items()}
    return Evidence(images, keypoints, matches)


def turned(camera: Camera, degrees: float, *, axis: int = 1) -> Camera:
    """The camera turned on the spot about one of its own axes."""
    one, two = (index for index in range(3) if index != axis)
    angle = np.radians(degrees)
    turn = torch.eye(4, dtype=torch.float64)
    turn[one, one] = turn[two, two] = np.cos(angle)
    turn[one, two], turn[two, one] = -np.sin(angle), np.sin(angle)
    return replace(camera, viewmat=turn @ camera.viewmat)


def shifted(camera: Camera, by: tuple[float, float, float]) -> Camera:
    """The camera moved in the world."""
    viewmat = camera.viewmat.clone()
    viewmat[:3, 3] -= viewmat[:3, :3] @ torch.tensor(by, dtype=torch.float64)
    return replace(camera, viewmat=viewmat)


def farther(camera: Camera, factor: float) -> Camera:
    """The camera at so many times its distance from the origin, as in another unit."""
    viewmat = camera.viewmat.clone()
    viewmat[:3, 3] *= factor
    return replace(camera, viewmat=viewmat)
