# SPDX-License-Identifier: Apache-2.0
"""Anchors to Gaussians in CUDA kernels, beside the oracle in float64: the kernels' functions run on the processor and,
where there is a GPU, the kernels themselves.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import pytest
import torch
from torch import Tensor

from structgstream.cameras import Viewport
from structgstream.errors import BackendError
from structgstream.kernels import cuda_anchors, reference_anchors
from structgstream.kernels.cuda_library import KernelLibrary
from structgstream.kernels.values import Anchors, HeadWeights, MLPWeights, StructuredGaussians, TileSelection, tile_grid
from tests.parity.conftest import in_both_orders
from tests.support.splats import viewport_of

M, K, D, HIDDEN = 60, 5, 12, 16
WIDTH, HEIGHT = 53, 41
ATTRIBUTES = ("means", "quats", "scales", "opacities", "colors")
ONLINE = (0, 1, 2, 4, 9, 10, 11, 12)  # positions, both scales, features and F_c
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


@pytest.fixture(params=DEVICES)
def library(request: pytest.FixtureRequest, kernels_on: Callable[[str], KernelLibrary]) -> KernelLibrary:
    return kernels_on(request.param)


def generate(
    generator: Callable[..., StructuredGaussians],
    values: list[Tensor],
    *,
    tiles: TileSelection | None = None,
    distance_input: bool = True,
) -> StructuredGaussians:
    mlps = MLPWeights(*(HeadWeights(*values[i : i + 4]) for i in (5, 9, 13)))
    view = camera(values[0])
    return generator(Anchors(*values[:5]), mlps, view, distance_input=distance_input, tiles=tiles)


def on_device(values: list[Tensor], library: KernelLibrary) -> list[Tensor]:
    return [value.to(library.device_type, torch.float32) for value in values]


def some_tiles() -> TileSelection:
    return TileSelection(torch.rand(tile_grid(WIDTH, HEIGHT)) < 0.3, WIDTH, HEIGHT)


@pytest.mark.parametrize("tiled", [False, True])
@pytest.mark.parametrize("distance_input", [True, False])
def test_the_drawn_set_is_the_references(library: KernelLibrary, tiled: bool, distance_input: bool) -> None:
    values = tensors(distance_input=distance_input)
    tiles = some_tiles() if tiled else None
    there = None if tiles is None else replace(tiles, mask=tiles.mask.to(library.device_type))
    exact = generate(reference_anchors.generate_structured, values, distance_input=distance_input, tiles=tiles)
    found = generate(
        partial(cuda_anchors.generate_structured, library),
        on_device(values, library),
        distance_input=distance_input,
        tiles=there,
    )
    assert torch.equal(found.anchors.cpu(), exact.anchors)
    assert 0 < len(exact.anchors) < M
    assert torch.equal(found.gaussians.ids.cpu(), exact.gaussians.ids)
    assert torch.allclose(found.raw_opacities.cpu().double(), exact.raw_opacities, rtol=1e-4, atol=1e-5)
    for name in ATTRIBUTES:
        ours, wanted = getattr(found.gaussians, name).cpu().double(), getattr(exact.gaussians, name)
        assert torch.allclose(ours, wanted, rtol=1e-4, atol=1e-5), name


@pytest.mark.parametrize("trained", [ONLINE, tuple(range(17))], ids=["online", "all"])
@pytest.mark.parametrize("distance_input", [True, False])
def test_gradients(library: KernelLibrary, trained: tuple[int, ...], distance_input: bool) -> None:
    values = tensors(distance_input=distance_input)
    ours = on_device(values, library)
    for i in trained:
        values[i].requires_grad_()
        ours[i].requires_grad_()
    exact = generate(reference_anchors.generate_structured, values, distance_input=distance_input).gaussians
    found = generate(partial(cuda_anchors.generate_structured, library), ours, distance_input=distance_input).gaussians
    assert torch.equal(found.ids.cpu(), exact.ids)
    cotangents = {name: torch.randn_like(getattr(exact, name)) for name in ATTRIBUTES}
    wanted = torch.autograd.grad(
        [getattr(exact, name) for name in ATTRIBUTES],
        [values[i] for i in trained],
        [cotangents[name] for name in ATTRIBUTES],
    )
    got = torch.autograd.grad(
        [getattr(found, name) for name in ATTRIBUTES],
        [ours[i] for i in trained],
        [cotangents[name].to(found.ids.device, torch.float32) for name in ATTRIBUTES],
    )
    for i, a, b in zip(trained, got, wanted, strict=True):
        assert b.norm() > 0, i
        assert (a.cpu().double() - b).norm() <= 1e-4 * b.norm(), i


def test_anchors_at_the_centre_and_quaternions_of_length_zero(library: KernelLibrary) -> None:
    """Directions and rotations that are none stay finite, forward and backward, as the oracle's do."""
    values = [value.float() for value in tensors(distance_input=True)]
    values[0][0] = camera(values[0]).center
    values[15][3:7], values[16][3:7] = 0.0, 0.0  # F_Sigma's rotation of every first Gaussian
    ours = on_device(values, library)
    for i in ONLINE:
        values[i].requires_grad_()
        ours[i].requires_grad_()
    exact = generate(reference_anchors.generate_structured, values).gaussians
    found = generate(partial(cuda_anchors.generate_structured, library), ours).gaussians
    assert torch.equal(found.ids.cpu(), exact.ids)
    assert torch.allclose(found.quats.cpu(), exact.quats, atol=1e-5)
    assert (exact.quats.norm(dim=1) == 0).any()
    gradients = torch.autograd.grad(
        sum(getattr(found, name).sum() for name in ATTRIBUTES),  # type: ignore[arg-type]
        [ours[i] for i in ONLINE],
    )
    assert all(torch.isfinite(gradient).all() for gradient in gradients)


def test_elements_need_no_order(emulation: Callable[[int], KernelLibrary]) -> None:
    values, tiles = on_device(tensors(distance_input=True), emulation(0)), some_tiles()

    def run(library: KernelLibrary) -> list[Tensor]:
        leaves = [value.clone().requires_grad_() for value in values]
        g = generate(partial(cuda_anchors.generate_structured, library), leaves, tiles=tiles).gaussians
        total = sum((getattr(g, name) * (1 + i)).sum() for i, name in enumerate(ATTRIBUTES))
        return [g.means.detach(), *torch.autograd.grad(total, leaves)]  # type: ignore[arg-type]

    assert len(in_both_orders(emulation, run)[0])


def test_what_the_kernels_cannot_read(emulation: Callable[[int], KernelLibrary]) -> None:
    generator = partial(cuda_anchors.generate_structured, emulation(0))
    with pytest.raises(BackendError, match="float32"):
        generate(generator, tensors(distance_input=True))
    elsewhere = [value.float() for value in tensors(distance_input=True)]
    elsewhere[3] = elsewhere[3].to("meta")
    with pytest.raises(BackendError, match="not on meta"):
        generate(generator, elsewhere)
