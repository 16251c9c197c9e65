# SPDX-License-Identifier: Apache-2.0
"""The environment: a smooth, direction-dependent background colour behind all Gaussians."""

import math

import torch
from torch import Tensor

from structgstream.cameras import Camera
from structgstream.harmonics import sh_basis

INVISIBLE = 1.0 / 512.0
"""Transmittance below which the background changes a pixel by less than half an 8-bit level."""


def environment(coefficients: Tensor, directions: Tensor) -> Tensor:
    """sRGB ``[..., 3]`` in unit ``directions`` ``[..., 3]`` of the scene: ``0.5 + sum Y_i c_i``, clamped to [0, 1].

    Args:
        coefficients: ``[(degree + 1)^2, 3]`` (``harmonics.py``, Note [Spherical harmonics]).
        directions: away from the camera.
    """
    degree = math.isqrt(len(coefficients)) - 1
    return (0.5 + sh_basis(directions, degree) @ coefficients).clamp(0.0, 1.0)


def pixel_to_world(camera: Camera) -> Tensor:
    """``[3, 3]``, on the processor: a pixel (x, y, 1) times it is a ray in world axes, not normalised."""
    return torch.linalg.inv(camera.K).T @ camera.viewmat[:3, :3]  # a GPU's inverse would be waited for


def pixel_directions(camera: Camera, pixels: Tensor) -> Tensor:
    """Unit directions ``[N, 3]``, in world axes, of the centres of ``pixels`` ``[N]`` (row-major indices).

    They are the same in the units of the capture and of the scene, because the similarity does not rotate.
    """
    y = torch.div(pixels, camera.width, rounding_mode="floor")
    centers = torch.stack([pixels - y * camera.width + 0.5, y + 0.5, torch.ones_like(y)], dim=1)
    rays = centers @ pixel_to_world(camera).to(centers)
    return rays * rays.square().sum(1, keepdim=True).rsqrt()


def in_environment(image: Tensor, alpha: Tensor, camera: Camera, coefficients: Tensor) -> Tensor:
    """``image`` ``[H, W, 3]``, drawn on black with coverage ``alpha`` ``[H, W]``, composited over the environment."""
    rest = 1.0 - alpha.reshape(-1)
    pixels = (rest > INVISIBLE).nonzero()[:, 0]
    behind = environment(coefficients.to(image), pixel_directions(camera, pixels).to(image))
    return image.reshape(-1, 3).index_add(0, pixels, rest[pixels, None] * behind).reshape(image.shape)
