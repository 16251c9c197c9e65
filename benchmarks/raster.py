# SPDX-License-Identifier: Apache-2.0
"""The rasteriser, forward and backward: this package's C++ against its own vectorised torch reference."""

import math
from functools import partial

import torch
from torch import Tensor

from benchmarks.benchmark import PICTURES, Benchmark, Growth, Variant
from benchmarks.contest import Contestant, Quantity
from benchmarks.roofline import Work
from structgstream.cameras import Viewport
from structgstream.gaussians import Gaussians
from structgstream.geometry import quaternion_matrices
from structgstream.kernels import cpu_raster, reference_raster
from structgstream.kernels.values import Rasterizer

Workload = tuple[Gaussians, Viewport, Tensor]
"""The Gaussians, where they are seen from, and the gradient of the picture."""


def workload(splats: int, width: int, height: int) -> Workload:
    """Gaussians on a wavy surface 1 to 4.5 units away, about a quarter of them outside the picture; seeded."""
    g = torch.Generator().manual_seed(0)
    focal = 0.83 * width
    u, v = (torch.rand(2, splats, generator=g) * 1.3 - 0.15).unbind(0)
    z = 2.75 + 1.25 * torch.sin(7.0 * u) * torch.cos(5.0 * v) + 0.5 * (torch.rand(splats, generator=g) - 0.5)
    means = torch.stack([(u - 0.5) * width / focal * z, (v - 0.5) * height / focal * z, z], dim=1)
    pixels = 1.15 * torch.exp(0.5 * torch.randn(splats, 3, generator=g))
    tensors = [
        means,
        torch.randn(splats, 4, generator=g),
        pixels * z[:, None] / focal,
        torch.sigmoid(0.3 + 1.5 * torch.randn(splats, generator=g)),
        torch.rand(splats, 3, generator=g),
    ]
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    cotangent = torch.randn(height, width, 3, generator=g)
    means, quats, scales, opacities, colors = (tensor.requires_grad_() for tensor in tensors)
    gaussians = Gaussians(means, quats, scales, opacities, colors, torch.arange(splats))
    return gaussians, Viewport(torch.eye(4), K, torch.zeros(3), width, height, near=0.1), cotangent


def forward_and_backward(rasterize: Rasterizer, work: Workload) -> list[Tensor]:
    """The picture and the gradients of all five inputs."""
    gaussians, viewport, cotangent = work
    inputs = [gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.colors]
    output = rasterize(gaussians, viewport)
    return [output.image, *torch.autograd.grad(output.image, inputs, cotangent)]


def contestants(*, splats: int, width: int, height: int) -> list[Contestant]:
    """The torch reference first, then the C++ with one and with two threads."""
    work = workload(splats, width, height)
    return [
        Contestant("torch reference, 2 threads", partial(forward_and_backward, reference_raster.rasterize, work), 2),
        Contestant("cpu, 1 thread", partial(forward_and_backward, cpu_raster.rasterize, work), 1),
        Contestant("cpu, 2 threads", partial(forward_and_backward, cpu_raster.rasterize, work), 2),
    ]


def blended_pairs(work: Workload) -> float:
    """How many (splat, pixel) pairs have an alpha of at least 1/255: the pixels inside each splat's ellipse.

    With 2D covariance S and opacity o the ellipse ``d S^-1 d = 2 ln(255 o)`` has the area
    ``2 pi ln(255 o) sqrt(det S)``; the part of its box inside the picture is taken of it. Pairs behind a pixel that is
    already opaque are counted although a rasteriser skips them: at this workload's depth few pixels get there.
    """
    gaussians, viewport, _ = work
    K, width, height = viewport.K, viewport.width, viewport.height
    with torch.no_grad():
        x, y, z = gaussians.means.unbind(1)
        zero = torch.zeros_like(z)
        fx, fy = K[0, 0], K[1, 1]
        jacobian = torch.stack([fx / z, zero, -fx * x / z**2, zero, fy / z, -fy * y / z**2], dim=1).reshape(-1, 2, 3)
        axes = jacobian @ (quaternion_matrices(gaussians.quats) * gaussians.scales[:, None])
        covariance = axes @ axes.transpose(1, 2) + 0.3 * torch.eye(2)
        reach = 2.0 * torch.log(255.0 * gaussians.opacities).clamp(min=0.0)
        area = math.pi * reach * torch.linalg.det(covariance).sqrt()
        size = torch.tensor([width, height])
        centre = torch.stack([fx * x / z + K[0, 2], fy * y / z + K[1, 2]], dim=1)
        half = (reach[:, None] * covariance.diagonal(dim1=1, dim2=2)).sqrt().clamp(min=1e-6)
        inside = ((centre + half).clamp(min=0).minimum(size) - (centre - half).clamp(min=0).minimum(size)) / (2 * half)
        return float((area * inside.prod(1)).sum())


def count(*, splats: int, width: int, height: int) -> Work:
    """Operations and bytes of one forward and backward pass.

    A pair (splat, pixel) forward: offsets 2, quadratic form 8, exponential 13 (range reduction 3, polynomial of degree
    5 as 10), alpha and weight 2, transmittance 2, three colours 6: 33. Backward: the same alpha again 25, transmittance
    2, colour gradients 6, the pixel's gradient dotted with the colour 5, the running remainder 2, gradient of alpha 4
    and of the exponent 1, six moments 12: 57. A splat: projection about 200, its backward about 500 (hand counts of
    the matrix products).

    Bytes: forward reads 14 floats a splat and writes a record of 16; backward reads both and writes 14 floats of
    gradients; pictures: 4 floats a pixel written, read again, and 3 of gradient read. Pairs live in caches.
    """
    pairs = blended_pairs(workload(splats, width, height))
    operations = pairs * (33 + 57) + splats * 700
    return Work(operations, 4.0 * (splats * (14 + 16 + 30 + 14) + width * height * 11))


def _sizes(splats: int, width: int, height: int) -> dict[str, int]:
    return {"splats": splats, "width": width, "height": height}


NATIVE = ("cpu, 1 thread", "cpu, 2 threads")  # at large sizes the reference takes seconds

BENCHMARK = Benchmark(
    name="raster",
    work="rasterisation of one picture, forward and backward",
    contestants=contestants,
    # Float32 against float32; measured medians are under 1e-5.
    quantities=[
        Quantity(name, 1e-4, "median")
        for name in ("image", *(f"{part}' gradient" for part in ("means", "quats", "scales", "opacities", "colors")))
    ],
    variants=[Variant("60,000 splats, 480x360", _sizes(60_000, 480, 360), _sizes(500, 64, 48))],
    growth=[
        Growth(
            "splats",
            {n: _sizes(n, 480, 360) for n in (7_500, 15_000, 30_000, 60_000, 120_000, 240_000)},
            {n: _sizes(n, 64, 48) for n in (250, 500)},
            only=NATIVE,
        ),
        Growth(
            "pixels (as many splats as a third of the pixels)",
            {w * h: _sizes(w * h // 3, w, h) for w, h in PICTURES},
            {w * h: _sizes(w * h // 3, w, h) for w, h in ((32, 24), (64, 48))},
            only=NATIVE,
        ),
    ],
    count=count,
)
