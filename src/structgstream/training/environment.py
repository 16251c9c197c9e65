# SPDX-License-Identifier: Apache-2.0
"""Least-squares fit of a scene's environment (``scene/environment.py``) to the training pictures of frame 0.

Note [Honest coverage]
~~~~~~~~~~~~~~~~~~~~~~
With a black background the optimiser represents dark surfaces by transparency. Coverage then does not distinguish dark
surfaces from unobserved regions, and an environment would shine through dark doors and hair. With a random background
colour in every iteration (``InitialConfig.random_background``) only opaque surfaces can match the pictures, so what
stays transparent is unobserved.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from structgstream.kernels.backend import Backend
from structgstream.scene.environment import pixel_directions
from structgstream.scene.harmonics import sh_basis
from structgstream.scene.render import draw
from structgstream.scene.scene import Scene
from structgstream.training.views import View

_STRIDE = 4  # pixels between samples: enough for a few coefficients
_LEAST_GAIN = 0.1


@dataclass(frozen=True)
class EnvironmentConfig:
    """The environment behind the scene; needs ``random_background`` (Note [Honest coverage])."""

    enabled: bool = False
    """Whether an environment is fitted (paper: no, black)."""
    degree: int = 2
    """Degree of the spherical harmonics, 0 to 2."""
    smoothness: float = 1e-3
    """Ridge penalty: for a coefficient of degree l, l (l + 1) times this times the mean weight of the pixels."""
    least_weight: float = 1e-2
    """Added to a pixel's transparency (1 - coverage) to give its weight, so that covered pixels count a little."""
    step: float = 1 / 256
    """Quantization step of the coefficients with the codec ``compact``, full scale 1."""


def fit_environment(scene: Scene, views: Sequence[View], *, config: EnvironmentConfig, backend: Backend) -> Tensor:
    """Coefficients ``[(degree + 1)^2, 3]`` of the colours in the pictures' directions, by least squares.

    Args:
        scene: frame 0; its coverage determines the pixels' weights, its colour correction the reference colours.
        views: the training pictures.
        config: of the fit.
        backend: the compute back-end.
    """
    count = (config.degree + 1) ** 2
    products = torch.zeros(count, count, dtype=torch.float64)
    targets = torch.zeros(count, 3, dtype=torch.float64)
    total, color = 0.0, scene.camera_color
    for view in views:
        with torch.no_grad():
            alpha = draw(scene.gaussians(view.camera, backend), view.camera, backend).alpha
        rows, columns = (torch.arange(0, size, _STRIDE, device=alpha.device) for size in alpha.shape)
        pixels = (rows[:, None] * alpha.shape[1] + columns).reshape(-1)
        gains, biases = (value[view.index].cpu().double() for value in (color.gains, color.biases))
        colors = (view.image.reshape(-1, 3)[pixels].cpu().double() / 255.0 - biases) / gains.clamp(min=_LEAST_GAIN)
        weights = (1.0 - alpha.reshape(-1)[pixels]).cpu().double() + config.least_weight
        if view.mask is not None:
            weights = weights * view.mask.reshape(-1)[pixels].cpu()
        basis = sh_basis(pixel_directions(view.camera, pixels).cpu().double(), config.degree)
        products += (basis * weights[:, None]).T @ basis
        targets += (basis * weights[:, None]).T @ (colors - 0.5)
        total += float(weights.sum())
    degrees = torch.tensor([degree for degree in range(config.degree + 1) for _ in range(2 * degree + 1)])
    ridge = config.smoothness * total / (4.0 * torch.pi) * (degrees * (degrees + 1)).double()
    found = torch.linalg.solve(products + ridge.diag(), targets)
    return found.to(scene.anchors.positions)
