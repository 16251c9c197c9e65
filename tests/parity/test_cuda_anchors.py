# SPDX-License-Identifier: Apache-2.0
"""Structured Gaussians in shapes that do not depend on the numbers, beside the reference: the same drawn set, picture
and gradients. It is plain torch, so the processor tells as well as a GPU.
"""

import pytest
import torch
from torch import Tensor

from structgstream.cameras import Viewport
from structgstream.kernels import cuda_anchors, reference_anchors, reference_raster
from structgstream.kernels.values import Anchors, HeadWeights, MLPWeights, StructuredGaussians, TileSelection, tile_grid
from tests.support.splats import viewport_of

M, K, D, HIDDEN = 60, 5, 12, 16
WIDTH, HEIGHT = 53, 41
ATTRIBUTES = ("means", "quats", "scales", "opacities", "colors")
DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.needs_cuda)]


def tensors(*, distance_input: bool) -> list[Tensor]:
    """Positions, two log scales, offsets, features and the weights of three heads, float64."""
    inputs = D + 3 + distance_input
    depths = torch.linspace(1.5, 4.0, M)[torch.randperm(M)]  # well apart
    spread = (torch.rand(M, 2) * 3.0 - 1.5) * depths[:, None]  # about half of them out of sight
    values = [
        torch.cat([spread, depths[:, None]], dim=1),
        torch.randn(M, 3) * 0.2 - 1.5,
        torch.randn(M, 3) * 0.2 - 2.0,
        torch.randn(M, K, 3) * 0.3,
        torch.randn(M, D),
    ]
    for outputs in (K, 3 * K, 7 * K):
        values += [torch.randn(HIDDEN, inputs), torch.randn(HIDDEN), torch.randn(outputs, HIDDEN), torch.randn(outputs)]
        values[-2] *= 0.2
    return [value.double() for value in values]


def camera(like: Tensor) -> Viewport:
    viewmat = torch.eye(4).to(like)
    viewmat[0, 3] = 0.1
    K = torch.tensor([[40.0, 0, WIDTH / 2], [0, 42.0, HEIGHT / 2], [0, 0, 1]]).to(like)
    return viewport_of(viewmat, K, width=WIDTH, height=HEIGHT, near=0.2)


GENERATORS = cuda_anchors.generate_all_in_torch, reference_anchors.generate_structured


def generate(
    generator, values: list[Tensor], *, tiles: TileSelection | None = None, distance_input: bool = True
) -> StructuredGaussians:
    mlps = MLPWeights(*(HeadWeights(*values[i : i + 4]) for i in (5, 9, 13)))
    return generator(Anchors(*values[:5]), mlps, camera(values[0]), distance_input=distance_input, tiles=tiles)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("tiled", [False, True])
def test_who_is_looked_at(device: str, tiled: bool) -> None:
    """All anchors, and those that the reference does not look at say that they draw nothing."""
    values = [value.to(device) for value in tensors(distance_input=True)]
    mask = (torch.rand(tile_grid(WIDTH, HEIGHT)) < 0.3).to(device)
    tiles = TileSelection(mask, WIDTH, HEIGHT) if tiled else None
    ours, exact = (generate(generator, values, tiles=tiles) for generator in GENERATORS)
    assert torch.equal(ours.anchors, torch.arange(M, device=device))
    assert 0 < len(exact.anchors) < M
    assert (exact.anchors.diff() > 0).all()
    assert torch.equal((ours.raw_opacities > -1).any(1).nonzero()[:, 0], exact.anchors)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("distance_input", [True, False])
def test_the_drawn_set_is_the_references(device: str, distance_input: bool) -> None:
    values = [value.to(device) for value in tensors(distance_input=distance_input)]
    found, wanted = (generate(generator, values, distance_input=distance_input) for generator in GENERATORS)
    ours, exact = found.gaussians, wanted.gaussians
    drawn = ours.opacities > 0
    assert ours.means.shape == (M * K, 3)
    assert 0 < len(exact.ids) < M * K
    assert torch.equal(ours.ids[drawn], exact.ids)
    for name in ATTRIBUTES:
        assert torch.isfinite(getattr(ours, name)).all()
        assert torch.allclose(getattr(ours, name)[drawn], getattr(exact, name), rtol=1e-10, atol=1e-12), name
    assert not ours.scales[~drawn].any()
    assert not ours.opacities[~drawn].any()
    assert torch.allclose(found.raw_opacities[wanted.anchors], wanted.raw_opacities)
    assert (found.raw_opacities.clamp(min=0.0).sum(1) > 0).sum() <= len(wanted.anchors)
    assert not found.raw_opacities.requires_grad


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("trained", [(0, 1, 13, 14, 15, 16), tuple(range(17))], ids=["online", "all"])
def test_gradients_of_the_drawn_set(device: str, trained: tuple[int, ...]) -> None:
    values = [value.to(device) for value in tensors(distance_input=True)]
    for i in trained:
        values[i].requires_grad_()
    ours, exact = (generate(generator, values).gaussians for generator in GENERATORS)
    drawn = ours.opacities > 0
    cotangents = {name: torch.randn_like(getattr(exact, name)) for name in ATTRIBUTES}
    leaves = [values[i] for i in trained]
    found = torch.autograd.grad(
        [getattr(ours, name)[drawn] for name in ATTRIBUTES], leaves, [cotangents[name] for name in ATTRIBUTES]
    )
    wanted = torch.autograd.grad(
        [getattr(exact, name) for name in ATTRIBUTES], leaves, [cotangents[name] for name in ATTRIBUTES]
    )
    for i, a, b in zip(trained, found, wanted, strict=True):
        assert (a - b).norm() <= 1e-10 * b.norm(), i


def test_pictures_and_their_gradients() -> None:
    """What is not drawn leaves no trace: neither in the picture nor, with opacity and scale 0, in any gradient."""
    values = tensors(distance_input=True)
    trained = (0, 1, 13, 14, 15, 16)
    for i in trained:
        values[i].requires_grad_()
    weights = torch.rand(HEIGHT, WIDTH, 3, dtype=torch.float64)
    pictures, gradients = [], []
    for generator in GENERATORS:
        g = generate(generator, values).gaussians
        image = reference_raster.rasterize(g, camera(values[0])).image
        loss = (image * weights).sum() + g.scales.prod(1).sum() / (g.opacities > 0).sum()
        pictures.append(image.detach())
        gradients.append(torch.autograd.grad(loss, [values[i] for i in trained]))
    assert pictures[0].amax() > 0.1
    assert torch.allclose(*pictures, rtol=0, atol=1e-10)
    for a, b in zip(*gradients, strict=True):
        assert b.norm() > 0
        assert (a - b).norm() <= 1e-9 * b.norm()


@pytest.mark.needs_cuda
def test_nothing_waits_for_the_gpu() -> None:
    values = [value.float().cuda().requires_grad_() for value in tensors(distance_input=True)]
    mlps, view = MLPWeights(*(HeadWeights(*values[i : i + 4]) for i in (5, 9, 13))), camera(values[0])
    torch.cuda.set_sync_debug_mode("error")
    try:
        g = cuda_anchors.generate_all_in_torch(Anchors(*values[:5]), mlps, view, distance_input=True).gaussians
        torch.autograd.grad(sum(getattr(g, name).sum() for name in ATTRIBUTES), values)  # type: ignore[arg-type]
    finally:
        torch.cuda.set_sync_debug_mode("default")
