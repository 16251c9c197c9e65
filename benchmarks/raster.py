# SPDX-License-Identifier: Apache-2.0
"""The rasteriser, forward and backward: this package's C++ against its own vectorised torch reference."""

from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor

from benchmarks.contest import Contestant
from structgstream.kernels import cpu_raster, reference_raster


def workload(splats: int, width: int, height: int) -> tuple[list[Tensor], Tensor, Tensor, Tensor]:
    """Gaussians on a wavy surface 1 to 4.5 units away, about a quarter of them outside the picture; seeded."""
    g = torch.Generator().manual_seed(0)
    focal = 0.83 * width
    u, v = (torch.rand(2, splats, generator=g) * 1.3 - 0.15).unbind(0)
    z = 2.75 + 1.25 * torch.sin(7.0 * u) * torch.cos(5.0 * v) + 0.5 * (torch.rand(splats, generator=g) - 0.5)
    means = torch.stack([(u - 0.5) * width / focal * z, (v - 0.5) * height / focal * z, z], dim=1)
    pixels = 1.15 * torch.exp(0.5 * torch.randn(splats, 3, generator=g))
    gaussians = [
        means,
        torch.randn(splats, 4, generator=g),
        pixels * z[:, None] / focal,
        torch.sigmoid(0.3 + 1.5 * torch.randn(splats, generator=g)),
        torch.rand(splats, 3, generator=g),
    ]
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    cotangent = torch.randn(height, width, 3, generator=g)
    return [tensor.requires_grad_() for tensor in gaussians], torch.eye(4), K, cotangent


def forward_and_backward(
    rasterize: Callable[..., object], work: tuple[list[Tensor], Tensor, Tensor, Tensor]
) -> list[Tensor]:
    """The picture and the gradients of all five inputs."""
    gaussians, viewmat, K, cotangent = work
    height, width = cotangent.shape[:2]
    output = rasterize(*gaussians, viewmat, K, width=width, height=height, near=0.1)
    return [output.image, *torch.autograd.grad(output.image, gaussians, cotangent)]  # type: ignore[attr-defined]


def contestants(*, splats: int = 60_000, width: int = 480, height: int = 360) -> list[Contestant]:
    """The torch reference first, then the C++ with one and with two threads."""
    work = workload(splats, width, height)
    return [
        Contestant("torch reference, 2 threads", partial(forward_and_backward, reference_raster.rasterize, work), 2),
        Contestant("cpu, 1 thread", partial(forward_and_backward, cpu_raster.rasterize, work), 1),
        Contestant("cpu, 2 threads", partial(forward_and_backward, cpu_raster.rasterize, work), 2),
    ]
