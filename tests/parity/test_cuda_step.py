# SPDX-License-Identifier: Apache-2.0
"""Whole iterations of the cuda back-end's operations move the anchors as the reference's do: its kernels run on the
processor and, where there is a GPU, there.
"""

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from structgstream.cameras import Viewport
from structgstream.kernels.backend import Backend, kernel_functions, reference_backend
from structgstream.kernels.cuda_library import KernelLibrary
from structgstream.kernels.values import Anchors, HeadWeights, MLPWeights

M, K, D, HIDDEN, WIDTH, HEIGHT = 40, 4, 6, 8, 48, 40
STEPS = 4


def anchors() -> list[Tensor]:
    """Positions, two log scales, offsets, features and the weights of three heads."""
    generator = torch.Generator().manual_seed(5)

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
    return values


TRAINED = (0, 1, 13, 14, 15, 16)  # positions, offset scales, F_Sigma: the paper's dynamic set


class Fit:
    """Anchors, Adam's moments and one iteration over both; everything moves in place."""

    def __init__(self, backend: Backend, dtype: torch.dtype) -> None:
        self.backend = backend
        values = [value.to(backend.device, dtype) for value in anchors()]
        self.values = [value.requires_grad_(i in TRAINED) for i, value in enumerate(values)]
        self.moments = [(torch.zeros_like(self.values[i]), torch.zeros_like(self.values[i])) for i in TRAINED]

    @property
    def state(self) -> list[Tensor]:
        return [self.values[i] for i in TRAINED] + [moment for pair in self.moments for moment in pair]

    def step(self, viewmat: Tensor, intrinsics: Tensor, center: Tensor, image: Tensor, number: int) -> Tensor:
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
        return loss.detach()

    def run(self) -> list[float]:
        """The losses of some iterations, over two views in turn."""
        losses = []
        like = self.values[0].detach()
        for n in range(1, STEPS + 1):
            viewmat = torch.eye(4).to(like)
            viewmat[0, 3] = 0.1 * (n % 2)
            intrinsics = torch.tensor([[35.0, 0, WIDTH / 2], [0, 36.0, HEIGHT / 2], [0, 0, 1]]).to(like)
            generator = torch.Generator().manual_seed(n % 2)
            image = torch.randint(0, 256, (HEIGHT, WIDTH, 3), generator=generator, dtype=torch.uint8)
            losses.append(float(self.step(viewmat, intrinsics, -viewmat[:3, 3], image.to(like.device), n)))
        return losses


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.needs_cuda)])
def test_anchors_move_as_with_the_reference_and_in_every_run_alike(
    kernels_on: Callable[[str], KernelLibrary], device: str
) -> None:
    backend = replace(reference_backend(), device=torch.device(device)).with_functions(
        **kernel_functions(kernels_on(device))
    )
    exact, *fits = (Fit(*of) for of in ((reference_backend(), torch.float64), *[(backend, torch.float32)] * 2))
    exact_losses, losses, again = exact.run(), *(fit.run() for fit in fits)
    assert losses == again
    assert losses == pytest.approx(exact_losses, rel=1e-5)
    assert exact_losses[2] != exact_losses[0]
    for ours, repeated, theirs in zip(fits[0].state, fits[1].state, exact.state, strict=True):
        assert torch.equal(ours, repeated)
        assert (ours.cpu() - theirs).norm() <= 1e-4 * theirs.norm()
