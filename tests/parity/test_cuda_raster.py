# SPDX-License-Identifier: Apache-2.0
"""What stands between this package and gsplat's kernels, with kernels pretended in torch that keep to the interface of
gsplat 1.5.3 as its sources state it; and, where there is a GPU, the same with the kernels themselves.
"""

import sys
from functools import partial
from types import ModuleType

import pytest
import torch
from torch import Tensor

from structgstream.cameras import Viewport
from structgstream.kernels import cuda, reference_raster
from structgstream.kernels.cuda_library import kernel_library
from structgstream.kernels.cuda_tiles import PairBudget
from structgstream.kernels.values import TILE_PIXELS, Rasterizer, TileSelection, tile_grid
from tests.support.splats import splats_of, viewport_of

WIDTH, HEIGHT, NEAR, COUNT = 41, 35, 0.2, 30
PAIRS = 700


def projection(means, covars, quats, scales, viewmats, Ks, width, height, *, opacities, near_plane, eps2d, packed):
    assert (covars, eps2d, packed) == (None, 0.3, False)
    assert viewmats.shape == (1, 4, 4)
    assert Ks.shape == (1, 3, 3)
    view = viewport_of(viewmats[0], Ks[0], width=width, height=height, near=near_plane)
    p = reference_raster._project(splats_of(means, quats, scales, opacities, means), view, None)
    count = means.shape[0]

    def whole(values: Tensor, rest: float) -> Tensor:
        return values.new_full((count, *values.shape[1:]), rest).index_put((p.rows,), values)[None]

    rubbish = 1e30  # gsplat leaves what it culls as it finds it
    radii = whole(p.extents.ceil(), 0.0).to(torch.int32)
    return radii, whole(p.means2d, rubbish), whole(p.depths, rubbish), whole(p.conics, rubbish), None


def isect_tiles(means2d, radii, depths, tile_size, tile_width, tile_height, *, packed, n_images):
    assert (tile_size, packed, n_images) == (TILE_PIXELS, False, 1)
    means2d, depths = means2d.detach(), depths.detach()
    pairs = []
    for i in range(radii.shape[1]):
        if (radii[0, i] <= 0).any():
            continue
        low, high = ((means2d[0, i] + sign * radii[0, i]) / tile_size for sign in (-1, 1))
        x0, y0 = (max(0, int(edge)) for edge in low.floor())
        x1, y1 = (min(size, int(edge)) for edge, size in zip(high.ceil(), (tile_width, tile_height)))
        pairs += [(y * tile_width + x, float(depths[0, i]), i) for y in range(y0, y1) for x in range(x0, x1)]
    pairs.sort()
    return None, torch.tensor([tile for tile, _, _ in pairs]), torch.tensor([i for *_, i in pairs], dtype=torch.int32)


def isect_offset_encode(tile_ids, n_images, tile_width, tile_height):
    return torch.searchsorted(tile_ids, torch.arange(tile_width * tile_height), out_int32=True)


def rasterize_to_pixels(
    means2d, conics, colors, opacities, width, height, tile_size, starts, ids, *, backgrounds, masks, packed
):
    assert starts.dtype == ids.dtype == torch.int32
    assert masks is None or masks.shape == starts.shape
    rows, columns = starts.shape[1:]
    assert rows * tile_size >= height
    assert columns * tile_size >= width
    bounds = [*starts.flatten().tolist(), len(ids)]
    lines = []
    for row in range(rows):
        parts = []
        for column in range(columns):
            tile = row * columns + column
            listed = ids[bounds[tile] : bounds[tile + 1]].long()
            if masks is not None and not masks[0, row, column]:
                listed = listed[:0]
            y, x = torch.meshgrid(torch.arange(tile_size), torch.arange(tile_size), indexing="ij")
            pixels = torch.stack([column * tile_size + x + 0.5, row * tile_size + y + 0.5], dim=-1).to(means2d)
            delta = pixels[:, :, None] - means2d[0, listed]
            a, b, c = conics[0, listed].unbind(1)
            power = 0.5 * (a * delta[..., 0] ** 2 + c * delta[..., 1] ** 2) + b * delta[..., 0] * delta[..., 1]
            alpha = (opacities[0, listed] * torch.exp(-power)).clamp(max=reference_raster.MAX_ALPHA)
            alpha = torch.where(alpha < reference_raster.MIN_ALPHA, 0.0, alpha)
            light = torch.cat([alpha.new_ones(tile_size, tile_size, 1), (1 - alpha).cumprod(-1)], dim=-1)
            image = (alpha * light[..., :-1]) @ colors[0, listed]
            if backgrounds is not None:
                image = image + light[..., -1:] * backgrounds[0]
            parts.append(torch.cat([image, 1 - light[..., -1:]], dim=-1))
        lines.append(torch.cat(parts, dim=1))
    whole = torch.cat(lines)[None, :height, :width]
    return whole[..., :3], whole[..., 3:]


@pytest.fixture
def pretended(monkeypatch: pytest.MonkeyPatch) -> None:
    names = ("gsplat", "gsplat.cuda", "gsplat.cuda._wrapper")
    for name in names:
        monkeypatch.setitem(sys.modules, name, ModuleType(name))
    wrapper = sys.modules[names[-1]]
    wrapper.fully_fused_projection = projection  # type: ignore[attr-defined]
    wrapper.isect_tiles = isect_tiles  # type: ignore[attr-defined]
    wrapper.isect_offset_encode = isect_offset_encode  # type: ignore[attr-defined]
    wrapper.rasterize_to_pixels = rasterize_to_pixels  # type: ignore[attr-defined]


def splats(device: str) -> list[Tensor]:
    """Means, rotations, scales, opacities, colours and screen offsets; no pixel gets dark enough to stop early."""
    depths = torch.linspace(1.0, 4.0, COUNT)[torch.randperm(COUNT)]
    means = torch.cat([(torch.rand(COUNT, 2) * 1.6 - 0.8) * depths[:, None], depths[:, None]], dim=1)
    opacities = torch.rand(COUNT) * 0.3 + 0.1
    opacities[::7] = 0.0  # as structured Gaussians that are not drawn
    scales = torch.exp(torch.randn(COUNT, 3) * 0.3 - 2.5)
    scales[::7] = 0.0
    values = [means, torch.randn(COUNT, 4), scales, opacities, torch.rand(COUNT, 3), torch.zeros(COUNT, 2)]
    return [value.to(device, torch.float32 if device == "cuda" else torch.float64) for value in values]


def camera(like: Tensor) -> Viewport:
    K = torch.tensor([[30.0, 0, 20.0], [0, 31.0, 17.0], [0, 0, 1]])
    return viewport_of(torch.eye(4).to(like), K.to(like), width=WIDTH, height=HEIGHT, near=NEAR)


def run(rasterize: Rasterizer, values: list[Tensor], **options) -> tuple[list[Tensor], list[Tensor]]:
    """Picture, coverage and radii, and the gradients of all inputs for fixed cotangents."""
    leaves = [value.clone().requires_grad_() for value in values]
    output = rasterize(splats_of(*leaves[:5]), camera(values[0]), screen_offsets=leaves[5], **options)
    generator = torch.Generator().manual_seed(3)
    v_image = torch.rand(HEIGHT, WIDTH, 3, generator=generator).to(values[0])
    gradients = torch.autograd.grad((output.image * v_image).sum() + output.alpha.sum(), leaves)
    return [output.image.detach(), output.alpha.detach(), output.radii], list(gradients)


def asked(device: str) -> TileSelection:
    mask = torch.ones(tile_grid(WIDTH, HEIGHT), dtype=torch.bool, device=device)
    mask[0, 1] = mask[2, 0] = False
    return TileSelection(mask, WIDTH, HEIGHT)


@pytest.mark.usefixtures("pretended")
@pytest.mark.parametrize("budgeted", [False, True])
@pytest.mark.parametrize("case", ["plain", "background", "tiles", "onto", "trained"])
def test_the_picture_and_its_gradients_are_the_references(budgeted: bool, case: str) -> None:
    values = splats("cpu")
    options = {
        "plain": {},
        "background": {"background": torch.tensor([0.2, 0.5, 0.1], dtype=torch.float64)},
        "tiles": {"tiles": asked("cpu")},
        "onto": {"tiles": asked("cpu")},
        "trained": {"trained": 20},
    }[case]
    budget = PairBudget.of(PAIRS, torch.device("cpu")) if budgeted else None
    pictures = torch.rand(HEIGHT, WIDTH, 3, dtype=torch.float64).expand(2, HEIGHT, WIDTH, 3).clone()
    ontos = [{"onto": picture} if case == "onto" else {} for picture in pictures]
    exact, exact_gradients = run(reference_raster.rasterize, values, **options, **ontos[0])
    ours, gradients = run(partial(cuda.rasterize, budget=budget), values, **options, **ontos[1])
    assert exact[1].amax() > 0.3
    for got, truth in zip(ours[:2], exact[:2], strict=True):
        assert torch.allclose(got, truth, rtol=0, atol=1e-9)
    for i, (got, truth) in enumerate(zip(gradients, exact_gradients, strict=True)):
        assert (got - truth).norm() <= 1e-8 * (truth.norm() + 1e-3), i
    if budget is not None:
        assert 30 < int(budget.needed) < PAIRS
        assert budget.shortage() == 0


@pytest.mark.usefixtures("pretended")
def test_with_tiles_who_reaches_none_counts_as_not_drawn_and_the_picture_is_drawn_onto() -> None:
    values = splats("cpu")
    tiles = asked("cpu")
    tiles.mask[1:] = False
    pictures = [torch.rand(HEIGHT, WIDTH, 3, dtype=torch.float64) for _ in range(2)]
    outputs = [
        rasterize(splats_of(*values[:5]), camera(values[0]), tiles=tiles, onto=picture)
        for rasterize, picture in zip((reference_raster.rasterize, cuda.rasterize), pictures, strict=True)
    ]
    for output, picture in zip(outputs, pictures, strict=True):
        assert output.image.data_ptr() == picture.data_ptr()
    pixels = tiles.pixels()[..., None].expand(-1, -1, 1).double()
    shown = reference_raster.blending_weights(splats_of(*values[:5]), camera(values[0]), pixels)
    everything = cuda.rasterize(splats_of(*values[:5]), camera(values[0]))
    assert 0 < (shown > 0).sum() <= (outputs[1].radii > 0).sum() < (everything.radii > 0).sum()
    assert (outputs[1].radii[shown[:, 0] > 0] > 0).all()


@pytest.mark.usefixtures("pretended")
def test_a_budget_that_is_too_small_says_so() -> None:
    budget = PairBudget.of(20, torch.device("cpu"))
    run(partial(cuda.rasterize, budget=budget), splats("cpu"))
    missing = budget.shortage()
    assert missing > 0
    assert PairBudget.of(20 + missing, torch.device("cpu")).shortage() == 0


@pytest.mark.needs_cuda
@pytest.mark.parametrize("tiled", [False, True])
@pytest.mark.parametrize("kernels", [False, True])
def test_with_a_budget_gsplat_draws_the_same(tiled: bool, kernels: bool) -> None:
    values, budget = splats("cuda"), PairBudget.of(PAIRS, torch.device("cuda"))
    options = {"tiles": asked("cuda")} if tiled else {}
    library = kernel_library()[0] if kernels else None
    assert (library is not None) is kernels
    plain, plain_gradients = run(cuda.rasterize, values, **options)
    ours, gradients = run(partial(cuda.rasterize, budget=budget, library=library), values, **options)
    assert 30 < int(budget.needed) < PAIRS
    assert all(torch.equal(a, b) for a, b in zip(ours, plain, strict=True))
    for got, truth in zip(gradients, plain_gradients, strict=True):  # gsplat adds gradients in any order
        assert torch.allclose(got, truth, rtol=1e-4, atol=1e-6)


@pytest.mark.needs_cuda
def test_with_a_budget_nothing_waits_for_the_gpu() -> None:
    values, budget = splats("cuda"), PairBudget.of(PAIRS, torch.device("cuda"))
    leaves = [value.requires_grad_() for value in values]
    splats_, view, tiles = splats_of(*leaves[:5]), camera(values[0]), asked("cuda")

    def once() -> None:
        output = cuda.rasterize(
            splats_, view, screen_offsets=leaves[5], budget=budget, library=kernel_library()[0], tiles=tiles, trained=20
        )
        torch.autograd.grad(output.image.sum(), leaves)

    once()  # the kernels are loaded
    torch.cuda.set_sync_debug_mode("error")
    try:
        once()
    finally:
        torch.cuda.set_sync_debug_mode("default")
