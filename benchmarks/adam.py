# SPDX-License-Identifier: Apache-2.0
"""The optimiser step of all anchor tensors and MLPs: this package's C++, its torch form, and torch.optim.Adam."""

from collections.abc import Callable
from typing import Literal

import torch
from torch import Tensor

from benchmarks.benchmark import Benchmark, Growth, Variant
from benchmarks.contest import Contestant, Quantity, Results
from benchmarks.world import wall_scene
from structgstream.kernels import cpu_losses, reference_losses
from structgstream.scene.state import PAPER_DYNAMIC, fields_of, state_of
from structgstream.training.optim import BETAS, EPS

Trained = Literal["all", "online"]
RATE = 1e-3


def parameters(anchors: int, trained: Trained) -> tuple[list[Tensor], list[Tensor]]:
    """Parameters of a scene of ``anchors`` anchors and seeded gradients; ``online``: the paper's dynamic set."""
    state = state_of(wall_scene(anchors, cameras=1))
    values = [
        value
        for name, value in state.items()
        if name in fields_of("anchor", "shared") and (trained == "all" or name in PAPER_DYNAMIC)
    ]
    g = torch.Generator().manual_seed(2)
    return [value.clone() for value in values], [torch.randn(value.shape, generator=g) for value in values]


def _stepping(adam_step: Callable[..., None], anchors: int, trained: Trained) -> Callable[[], Results]:
    """One more step on the contestant's own copy at each call."""
    values, gradients = parameters(anchors, trained)
    moments = [(torch.zeros_like(value), torch.zeros_like(value)) for value in values]
    steps = [0]

    def run() -> Results:
        steps[0] += 1
        for value, gradient, (first, second) in zip(values, gradients, moments, strict=True):
            adam_step(value, gradient, first, second, lr=RATE, step=steps[0], betas=BETAS, eps=EPS)
        return [torch.cat([value.detach().reshape(-1) for value in values])]

    return run


def _torch_optim(anchors: int, trained: Trained, **options: bool) -> Callable[[], Results]:
    values, gradients = parameters(anchors, trained)
    for value, gradient in zip(values, gradients, strict=True):
        value.requires_grad_().grad = gradient
    optimiser = torch.optim.Adam(values, lr=RATE, betas=BETAS, eps=EPS, **options)

    def run() -> Results:
        optimiser.step()
        return [torch.cat([value.detach().reshape(-1) for value in values])]

    return run


def contestants(*, anchors: int, trained: Trained) -> list[Contestant]:
    """The torch reference first, the C++, and torch's own two implementations."""
    return [
        Contestant("torch reference, 2 threads", _stepping(reference_losses.adam_step, anchors, trained), 2),
        Contestant("cpu, 1 thread", _stepping(cpu_losses.adam_step, anchors, trained), 1),
        Contestant("cpu, 2 threads", _stepping(cpu_losses.adam_step, anchors, trained), 2),
        Contestant("torch.optim.Adam(fused), 2 threads", _torch_optim(anchors, trained, fused=True), 2),
        Contestant("torch.optim.Adam(foreach), 2 threads", _torch_optim(anchors, trained, foreach=True), 2),
    ]


def _sizes(anchors: int, trained: Trained) -> dict[str, object]:
    return {"anchors": anchors, "trained": trained}


BENCHMARK = Benchmark(
    name="adam",
    work="one optimiser step",
    contestants=contestants,
    # Compared after the first step, which moves every number by the rate: the bound is a thousandth of that.
    quantities=[Quantity("parameters", 1e-3 * RATE, "largest")],
    variants=[
        Variant("20,000 anchors, all trained", _sizes(20_000, "all"), _sizes(200, "all")),
        Variant("20,000 anchors, online set", _sizes(20_000, "online"), _sizes(200, "online")),
    ],
    growth=[
        Growth(
            "anchors (all trained)",
            {n: _sizes(n, "all") for n in (2_500, 5_000, 10_000, 20_000, 40_000, 80_000)},
            {n: _sizes(n, "all") for n in (100, 200)},
        )
    ],
)
