# SPDX-License-Identifier: Apache-2.0
"""Whole iterations in shapes that do not depend on numbers move the anchors as the reference's do: on the processor
with the reference's rasteriser, on a GPU with everything real.
"""

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from structgstream.cameras import Viewport
from structgstream.kernels import cuda, cuda_anchors
from structgstream.kernels.backend import Backend, cuda_backend, nonblocking, reference_backend
from structgstream.kernels.cuda_tiles import PairBudget
from structgstream.kernels.values import Anchors, HeadWeights, MLPWeights

M, K, D, HIDDEN, WIDTH, HEIGHT = 40, 4, 6, 8, 48, 40
STEPS = 4


def anchors(device: str) -> list[Tensor]:
    """Positions, two log scales, offsets, features and the weights of three heads."""
    generator = torch.Generator().manual_seed(5)
    dtype = torch.float32 if device == "cuda" else torch.float64

    def normal(*shape: int) -> Tensor:
        return torch.randn(shape, generator=generator, dtype=torch.float64)

    depths = torch.linspace(1.5, 3.0, M, dtype=torch.float64)
    values = [
        torch.cat([normal(M, 2) * 0.7 * depths[:, None], depths[:, None]], dim=1),
        normal(M, 3) * 0.2 - 1.5,
        normal(M, 3) * 0.2 - 2.2,
        normal(M, K, 3) * 0.3,
        normal(M, D),
    ]
    for outputs in (K, 3 * K, 7 * K):
        values += [normal(HIDDEN, D + 4), normal(HIDDEN), 0.3 * normal(outputs, HIDDEN), normal(outputs)]
    return [value.to(device, dtype) for value in values]


TRAINED = (0, 1, 13, 14, 15, 16)  # positions, offset scales, F_Sigma: the paper's dynamic set


class Fit:
    """Anchors, Adam's moments and one iteration over both; everything moves in place."""

    def __init__(self, backend: Backend, device: str) -> None:
        self.backend = backend
        self.values = [value.requires_grad_(i in TRAINED) for i, value in enumerate(anchors(device))]
        self.moments = [(torch.zeros_like(self.values[i]), torch.zeros_like(self.values[i])) for i in TRAINED]

    @property
    def state(self) -> list[Tensor]:
        return [self.values[i] for i in TRAINED] + [moment for pair in self.moments for moment in pair]

    def step(self, viewmat: Tensor, intrinsics: Tensor, center: Tensor, image: Tensor, number: int) -> tuple[Tensor]:
        v, backend = self.values, self.backend
        mlps = MLPWeights(*(HeadWeights(*v[i : i + 4]) for i in (5, 9, 13)))
        view = Viewport(viewmat, intrinsics, center, WIDTH, HEIGHT, near=0.2)
        g = backend.generate_structured(Anchors(*v[:5]), mlps, view, distance_input=True).gaussians
        picture = backend.rasterize(g, view)
        l1, ssim = backend.l1_ssim(picture.image, image)
        volume = g.scales[:, 0] * g.scales[:, 1] * g.scales[:, 2]
        loss = l1 + 0.2 * (1.0 - ssim) + 0.01 * volume.sum() / (g.opacities > 0).sum()
        gradients = torch.autograd.grad(loss, [v[i] for i in TRAINED])
        for i, gradient, (first, second) in zip(TRAINED, gradients, self.moments, strict=True):
            options = {"lr": 1e-3, "step": number, "betas": (0.9, 0.999), "eps": 1e-8}
            backend.adam_step(v[i].detach(), gradient, first, second, **options)
        return (loss.detach(),)

    def run(self, step: Callable[..., tuple[Tensor]], device: str) -> list[float]:
        """The losses of some iterations, over two views in turn."""
        losses = []
        like = self.values[0].detach()
        for n in range(1, STEPS + 1):
            viewmat = torch.eye(4).to(like)
            viewmat[0, 3] = 0.1 * (n % 2)
            intrinsics = torch.tensor([[35.0, 0, WIDTH / 2], [0, 36.0, HEIGHT / 2], [0, 0, 1]]).to(like)
            generator = torch.Generator().manual_seed(n % 2)
            image = torch.randint(0, 256, (HEIGHT, WIDTH, 3), generator=generator, dtype=torch.uint8).to(device)
            (loss,) = step(viewmat, intrinsics, -viewmat[:3, 3], image, n)
            losses.append(float(loss))
        return losses


def example(device: str) -> tuple[Tensor, Tensor, Tensor, Tensor, int]:
    floats = torch.float32 if device == "cuda" else torch.float64
    shapes = [((4, 4), floats), ((3, 3), floats), ((3,), floats), ((HEIGHT, WIDTH, 3), torch.uint8)]
    values = [torch.zeros(shape, dtype=dtype, device=device) for shape, dtype in shapes]
    values[0].fill_diagonal_(1.0)
    values[1].fill_diagonal_(35.0)[2, 2] = 1.0
    viewmat, intrinsics, center, image = values
    return viewmat, intrinsics, center, image, 1


def compare(ours: Fit, exact: Fit, losses: list[float], exact_losses: list[float], tolerance: float) -> None:
    assert losses == pytest.approx(exact_losses, rel=tolerance)
    assert exact_losses[2] != exact_losses[0]
    for a, b in zip(ours.state, exact.state, strict=True):
        assert (a - b).norm() <= tolerance * b.norm()


def test_fixed_shapes_move_the_anchors_as_the_reference() -> None:
    reference = reference_backend()
    fixed = reference.with_functions(generate_structured=cuda_anchors.generate_all_in_torch, adam_step=cuda.adam_step)
    exact, ours = Fit(reference, "cpu"), Fit(fixed, "cpu")
    exact_losses = exact.run(exact.step, "cpu")
    compare(
        ours, exact, ours.run(ours.step, "cpu"), exact_losses, 1e-6
    )  # torch's fused Adam counts its steps in float32


@pytest.mark.needs_cuda
def test_on_a_gpu() -> None:
    plain = cuda_backend()
    budget = PairBudget.of(20_000, plain.device)
    exact, ours = Fit(plain, "cuda"), Fit(nonblocking(plain, budget), "cuda")
    exact_losses = exact.run(exact.step, "cuda")
    losses = ours.run(ours.step, "cuda")
    assert budget.shortage() == 0
    compare(ours, exact, losses, exact_losses, 1e-3)  # gsplat adds gradients in any order


@pytest.mark.needs_cuda
def test_an_iteration_waits_for_nothing() -> None:
    plain = cuda_backend()
    fit = Fit(nonblocking(plain, PairBudget.of(20_000, plain.device)), "cuda")
    inputs = example("cuda")
    fit.step(*inputs)  # libraries load
    torch.cuda.set_sync_debug_mode("error")
    try:
        fit.step(*inputs)
    finally:
        torch.cuda.set_sync_debug_mode("default")
