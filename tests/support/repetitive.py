# SPDX-License-Identifier: Apache-2.0
"""Cameras around points of which many look alike, as keypoints without pictures."""

import numpy as np
import torch

from structgstream.cameras import Camera
from structgstream.data.calibration import rotation_matrix
from structgstream.data.lenses import LensCamera, Pinhole
from structgstream.preparation.calibration.keypoints import Keypoints

POINTS, LOOKS, NOISE_PIXELS = 600, 60, 0.3


def ring(count: int = 6) -> dict[str, LensCamera]:
    """Cameras on an arc of 75 degrees, three units from the points."""
    cameras = {}
    for index, angle in enumerate(np.linspace(-0.65, 0.65, count)):
        viewmat = np.eye(4)
        viewmat[:3, :3] = rotation_matrix(np.array([0.2 * np.sin(3 * index), angle, 0.0]))
        viewmat[:3, 3] = [0.0, 0.1 * np.cos(index), 3.0]
        K = torch.tensor([[600.0, 0, 320], [0, 600.0, 240], [0, 0, 1]], dtype=torch.float64)
        cameras[f"cam{index}"] = LensCamera(Camera(torch.from_numpy(viewmat), K, 640, 480), Pinhole())
    return cameras


def points() -> np.ndarray:
    """``[POINTS, 3]``."""
    return np.random.default_rng(0).uniform(-0.8, 0.8, (POINTS, 3))


def keypoints_of(cameras: dict[str, LensCamera]) -> dict[str, Keypoints]:
    """Keypoint ``n`` of each camera is point ``n``; ten points share each look, but for a little."""
    rng = np.random.default_rng(1)
    looks = rng.gamma(0.6, size=(LOOKS, 128))[np.arange(POINTS) % LOOKS]
    found = {}
    for name, filmed in cameras.items():
        pixels = filmed.pixels(points()) + rng.normal(0, NOISE_PIXELS, (POINTS, 2))
        own = np.sqrt(np.maximum(looks + rng.normal(0, 0.03, looks.shape), 0)).astype(np.float32)
        own /= np.linalg.norm(own, axis=1, keepdims=True)
        found[name] = Keypoints(pixels, own, np.ones((POINTS, 1), bool))
    return found
