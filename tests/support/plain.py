# SPDX-License-Identifier: Apache-2.0
"""Plain Gaussians, and how they look."""

import torch
from torch import Tensor

from structgstream.cameras import Camera
from structgstream.exporters.bake import BakedGaussians
from structgstream.kernels.backend import reference_backend
from structgstream.scene.render import render
from tests.support.rigs import arc_rig

RIG = arc_rig(4, width=64, height=48)


def some(count: int = 300, *, degree: int = 0) -> BakedGaussians:
    """Random Gaussians around the origin."""
    g = torch.Generator().manual_seed(3)
    quats = torch.nn.functional.normalize(torch.randn(count, 4, generator=g), dim=1)
    sh = torch.randn(count, (degree + 1) ** 2, 3, generator=g) * 0.3
    return BakedGaussians(
        means=torch.randn(count, 3, generator=g) * 0.5,
        quats=torch.where(quats[:, :1] < 0, -quats, quats),
        scales=torch.exp(torch.randn(count, 3, generator=g) * 0.5 - 3.0),
        opacities=torch.rand(count, generator=g) * 0.9 + 0.05,
        sh=sh,
    )


def picture(gaussians: BakedGaussians, camera: Camera = RIG["cam01"]) -> Tensor:
    return render(gaussians, camera, reference_backend()).image


def psnr(one: Tensor, other: Tensor) -> float:
    return float(-10 * (one - other).square().mean().log10())
