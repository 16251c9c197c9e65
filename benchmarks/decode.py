# SPDX-License-Identifier: Apache-2.0
"""Anchors to drawable Gaussians, forward and backward: this package's C++ against the torch reference."""

from collections.abc import Callable
from functools import partial
from typing import Literal

import torch
from torch import Tensor

from benchmarks.benchmark import Benchmark, Growth, Variant
from benchmarks.contest import Contestant, Quantity, Results
from benchmarks.roofline import Work
from benchmarks.world import FEATURES, HIDDEN, OFFSETS_PER_ANCHOR, wall_rig, wall_scene
from structgstream.kernels import cpu_anchors, reference_anchors
from structgstream.kernels.values import Anchors, HeadWeights, MLPWeights, StructuredGaussians

Trained = Literal["all", "online"]
"""``all``: as in frame 0; ``online``: the paper's dynamic set: positions, offset scales and the covariance head."""

ONLINE_TENSORS = (0, 1, *range(13, 17))  # Of the five anchor tensors and twelve weights.
DRAWN_NUMBERS = 14  # Of a drawn Gaussian: mean 3, quaternion 4, scales 3, opacity 1, colour 3.


def workload(anchors: int, trained: Trained) -> tuple[list[Tensor], Tensor]:
    """The five anchor tensors and the weights of three heads, and gradients ``[M * K, 14]`` by id."""
    scene = wall_scene(anchors, cameras=1)
    cloud = scene.anchors
    tensors = [cloud.positions, cloud.log_offset_scales, cloud.log_base_scales, cloud.offsets, cloud.features]
    tensors += [weight for head in scene.mlps for weight in head]
    leaves = [
        tensor.clone().requires_grad_(trained == "all" or index in ONLINE_TENSORS)
        for index, tensor in enumerate(tensors)
    ]
    g = torch.Generator().manual_seed(1)
    return leaves, torch.randn(anchors * OFFSETS_PER_ANCHOR, DRAWN_NUMBERS, generator=g)


def forward_and_backward(
    activate: Callable[..., StructuredGaussians], work: tuple[list[Tensor], Tensor], camera_center: Tensor
) -> Results:
    """Ids, the drawn Gaussians ``[N, 14]``, and the gradients of what is trained as two vectors."""
    leaves, cotangent = work
    heads = [HeadWeights(*leaves[5 + 4 * head : 9 + 4 * head]) for head in range(3)]
    visible = torch.arange(leaves[0].shape[0])
    anchors = Anchors(*leaves[:5])
    drawn = activate(anchors, MLPWeights(*heads), camera_center, visible, distance_input=True).gaussians
    outputs = [drawn.means, drawn.quats, drawn.scales, drawn.opacities, drawn.colors]
    given = cotangent.to(drawn.means)[drawn.ids].split((3, 4, 3, 1, 3), dim=1)
    given = [part[:, 0] if output.ndim == 1 else part for part, output in zip(given, outputs, strict=True)]
    wanted = [index for index, leaf in enumerate(leaves) if leaf.requires_grad]
    gradients = torch.autograd.grad(outputs, [leaves[index] for index in wanted], given)
    flat = [gradient.reshape(-1) for gradient in gradients]
    return [
        drawn.ids,
        torch.cat([output.detach().reshape(-1) for output in outputs]),
        torch.cat([gradient for index, gradient in zip(wanted, flat, strict=True) if index < 5]),
        torch.cat([gradient for index, gradient in zip(wanted, flat, strict=True) if index >= 5]),
    ]


def contestants(*, anchors: int, trained: Trained) -> list[Contestant]:
    """The torch reference first, then the C++ with one and with two threads; every anchor is visible."""
    work, center = workload(anchors, trained), _center()
    return [
        Contestant(
            "torch, 2 threads", partial(forward_and_backward, reference_anchors.activate_anchors, work, center), 2
        ),
        Contestant("cpu, 1 thread", partial(forward_and_backward, cpu_anchors.activate_anchors, work, center), 1),
        Contestant("cpu, 2 threads", partial(forward_and_backward, cpu_anchors.activate_anchors, work, center), 2),
    ]


def oracle(*, anchors: int, trained: Trained) -> Results:
    """The torch reference in float64."""
    leaves, cotangent = workload(anchors, trained)
    doubles = [leaf.detach().double().requires_grad_(leaf.requires_grad) for leaf in leaves]
    return forward_and_backward(reference_anchors.activate_anchors, (doubles, cotangent), _center().double())


def _center() -> Tensor:
    rig = wall_rig(2, width=480, height=360)
    return rig["cam00"].center.float()


def count(*, anchors: int, trained: Trained) -> Work:
    """Operations and bytes of one forward and backward pass, for anchors all of which draw something.

    Forward, an anchor: three hidden layers 3 * 36 * 32 multiply-adds, the outputs 32 * (5 + 15 + 35), two operations
    each, and 13 for the exponential in each activation, of which half are needed: half of the Gaussians are drawn.
    Backward: gradients of the hidden units cost the output layers once more. What is trained decides the rest: ``all``
    costs both layers again for the weights and the hidden layers for the inputs; ``online`` costs the weights of the
    covariance head and, because positions move the direction and the distance, 4 of the 36 inputs.

    Bytes: an anchor's 56 floats read by both passes, its gradients written (56, online 6), and for each drawn Gaussian
    14 floats and an id written, its gradients and values read.
    """
    inputs, outputs = FEATURES + 4, 11 * OFFSETS_PER_ANCHOR
    hidden_layer, output_layer = 2.0 * 3 * inputs * HIDDEN, 2.0 * HIDDEN * outputs
    operations = hidden_layer + output_layer + 13.0 * outputs * 0.5 + output_layer
    if trained == "all":
        operations += output_layer + 2.0 * hidden_layer
        written = 56
    else:
        operations += output_layer * 7 / 11 + hidden_layer / 3 + hidden_layer * 4 / inputs
        written = 6
    drawn = 0.5 * OFFSETS_PER_ANCHOR
    return Work(anchors * operations, anchors * (4.0 * (2 * 56 + written) + drawn * (4 * 42 + 8)))


def _sizes(anchors: int, trained: Trained) -> dict[str, object]:
    return {"anchors": anchors, "trained": trained}


BENCHMARK = Benchmark(
    name="decode",
    work="decoding all anchors for one camera (k = 5), forward and backward",
    contestants=contestants,
    # Against float64. Gradients of weights are sums over all anchors, those of anchors pass through unit quaternions.
    quantities=[
        Quantity("ids", 0.0, "largest"),
        Quantity("gaussians", 1e-5),
        Quantity("anchors' gradients", 1e-4),
        Quantity("weights' gradients", 1e-4),
    ],
    variants=[
        Variant("20,000 anchors, all trained", _sizes(20_000, "all"), _sizes(200, "all")),
        Variant(
            "20,000 anchors, online: positions, offset scales, covariance head",
            _sizes(20_000, "online"),
            _sizes(200, "online"),
        ),
    ],
    growth=[
        Growth(
            "anchors (online)",
            {n: _sizes(n, "online") for n in (2_500, 5_000, 10_000, 20_000, 40_000, 80_000)},
            {n: _sizes(n, "online") for n in (100, 200)},
        )
    ],
    oracle=oracle,
    count=count,
)
