# SPDX-License-Identifier: Apache-2.0
"""Cameras with lenses of every kind."""

import torch

from structgstream.cameras import Camera
from structgstream.data.lenses import Fisheye, Lens, LensCamera, RadialTangential

MILD = RadialTangential(k1=-0.2, k2=0.05, p1=0.001, p2=-0.002)
PINCUSHION = RadialTangential(k1=0.15)
WIDE = Fisheye(0.05, -0.01, 0.002, -0.001)
LENSES = [(MILD, 300.0), (PINCUSHION, 300.0), (WIDE, 300.0), (Fisheye(), 245.0), (RadialTangential(k1=-0.35), 250.0)]


def filmed(lens: Lens, focal: float = 300.0, *, width: int = 320, height: int = 240) -> LensCamera:
    """The principal point lies off the middle, and pixels are a little wider than high."""
    focal *= width / 640
    K = torch.tensor([[focal, 0, 0.49 * width], [0, 1.01 * focal, 0.53 * height], [0, 0, 1]], dtype=torch.float64)
    return LensCamera(Camera(torch.eye(4), K, width, height), lens)
