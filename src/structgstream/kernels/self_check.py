# SPDX-License-Identifier: Apache-2.0
"""Whether a GPU draws as the processor does: one small picture and its gradients, before a back-end is used.

Compilers, drivers and architectures differ more than tests on one machine can cover. A rasteriser that is wrong would
make a stream that looks bad and says nothing.
"""

import torch
from torch import Tensor

from structgstream.cameras import Viewport
from structgstream.gaussians import Gaussians
from structgstream.kernels.values import Rasterizer

SIDE = 40  # pixels: tiles are cut at the border
COUNT = 60  # Gaussians
TOLERANCE = 1e-3
"""Mean difference relative to the mean; a Gaussian near 1/255 may be missing in a pixel."""


def disagreement(rasterize: Rasterizer, oracle: Rasterizer, device: torch.device) -> str | None:
    """What ``rasterize`` on ``device`` computes otherwise than ``oracle`` on the processor, for a message; None if
    pictures and gradients agree."""
    found, expected = _picture_and_gradients(rasterize, device), _picture_and_gradients(oracle, torch.device("cpu"))
    for name, value in expected.items():
        error = float((found[name] - value).abs().mean() / value.abs().mean())
        if not error < TOLERANCE:
            return f"the {name} by {error:.2g}, relative to their mean"
    return None


def _picture_and_gradients(rasterize: Rasterizer, device: torch.device) -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(0)

    def numbers(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator)

    made = {
        "means": numbers(COUNT, 3) * 2.0 - 1.0,
        "quats": numbers(COUNT, 4) - 0.5,
        "scales": 0.05 + 0.2 * numbers(COUNT, 3),
        "opacities": 0.1 + 0.8 * numbers(COUNT),
        "colors": numbers(COUNT, 3),
    }
    weights = numbers(SIDE, SIDE, 3).to(device)
    leaves = {name: value.to(device).requires_grad_() for name, value in made.items()}
    viewmat, K = torch.eye(4), torch.tensor([[30.0, 0.0, SIDE / 2], [0.0, 30.0, SIDE / 2], [0.0, 0.0, 1.0]])
    viewmat[2, 3] = 3.0
    viewport = Viewport(viewmat.to(device), K.to(device), -viewmat[:3, 3].to(device), SIDE, SIDE, 0.1)
    drawn = rasterize(Gaussians(**leaves, ids=torch.arange(COUNT).to(device)), viewport)
    gradients = torch.autograd.grad((drawn.image * weights).sum() + drawn.alpha.sum(), list(leaves.values()))
    values = {"pictures": drawn.image.detach()}
    values |= {f"gradients of {name}": gradient for name, gradient in zip(leaves, gradients, strict=True)}
    return {name: value.cpu() for name, value in values.items()}
