# SPDX-License-Identifier: Apache-2.0
"""Several views drawn and weighed by the GPU's kernels, run on the processor, beside what the cpu back-end finds."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import pytest
import torch
from torch import Tensor

from structgstream.gaussians import Gaussians
from structgstream.kernels import cuda_anchors, cuda_picture, reference_raster
from structgstream.kernels.backend import Backend, cpu_backend
from structgstream.kernels.cuda_library import KernelLibrary
from structgstream.kernels.values import RasterOutput, TileSelection, tile_grid
from structgstream.scene.sampling import RigSampling
from structgstream.scene.scene import Scene
from tests.parity.conftest import in_both_orders
from tests.support.backends import needs_native
from tests.support.rigs import random_scene
from tests.support.worlds import moving_world

pytestmark = needs_native
RIG = moving_world(2).rig
CAMERAS = [RIG[name] for name in RIG.training]
VIEWPORTS = [camera.viewport(torch.zeros(0)) for camera in CAMERAS]
SIZE = (CAMERAS[0].height, CAMERAS[0].width)


def scene(*, filtered: bool = False) -> Scene:
    made = random_scene(60, free=3, cameras=len(CAMERAS), seed=4)
    return replace(made, sampling=RigSampling.of(RIG)) if filtered else made


def selections(seed: int) -> list[TileSelection]:
    generator = torch.Generator().manual_seed(seed)
    masks = torch.rand(len(CAMERAS), *tile_grid(SIZE[1], SIZE[0]), generator=generator) < 0.5
    return [TileSelection(mask, SIZE[1], SIZE[0]) for mask in masks]


@pytest.mark.parametrize("channels", [1, 7, 9])
@pytest.mark.parametrize("filtered", [False, True])
def test_pictures_and_weights(emulation: Callable[[int], KernelLibrary], channels: int, filtered: bool) -> None:
    cpu, shown = cpu_backend(), scene(filtered=filtered)
    gaussians, static = (part.gaussians_of_views(CAMERAS, cpu) for part in (shown, random_scene(20, seed=5)))
    if filtered:
        static = [replace(of, sampling_intervals=torch.full((len(of),), 0.05)) for of in static]
    slots = 60 * shown.anchors.offsets_per_anchor + 3
    generator = torch.Generator().manual_seed(1)
    maps = torch.rand(len(CAMERAS), *SIZE, channels, generator=generator)
    backgrounds = torch.rand(len(CAMERAS), 3, generator=generator)

    def run(library: KernelLibrary) -> list[Tensor]:
        images, sums = cuda_picture.draw_and_weigh_views(
            library, gaussians, VIEWPORTS, maps, slots=slots, backgrounds=backgrounds
        )
        assert torch.equal(cuda_picture.weigh_views(library, gaussians, VIEWPORTS, maps, slots=slots), sums)
        behind = cuda_picture.weigh_views(library, gaussians, VIEWPORTS, maps, slots=slots, static=static)
        return [images, sums, behind]

    images, sums, behind = in_both_orders(emulation, run)
    exact, exact_sums = cpu.draw_and_weigh_views(gaussians, VIEWPORTS, maps, slots=slots, backgrounds=backgrounds)
    exact_behind = cpu.weigh_views(gaussians, VIEWPORTS, maps, slots=slots, static=static)
    assert (images - exact).abs().max() < 1e-6
    for ours, theirs in ((sums, exact_sums), (behind, exact_behind)):
        assert (ours - theirs).norm() <= 1e-5 * theirs.norm()
    assert not torch.equal(sums, behind)


@pytest.mark.parametrize(("tiled", "onto"), [(False, False), (True, False), (True, True)])
def test_drawings(emulation: Callable[[int], KernelLibrary], tiled: bool, onto: bool) -> None:
    cpu = cpu_backend()
    gaussians, static = (part.gaussians_of_views(CAMERAS, cpu) for part in (scene(), random_scene(20, seed=5)))
    pictures = torch.rand(len(CAMERAS), *SIZE, 3, generator=torch.Generator().manual_seed(2))
    tiles = selections(3) if tiled else None

    def drawn(draw: Callable[..., list[RasterOutput]]) -> list[Tensor]:
        given = list(pictures.clone()) if onto else None
        found = draw(gaussians, VIEWPORTS, static=static, tiles=tiles, onto=given)
        assert given is None or all(torch.equal(of.image, one) for of, one in zip(found, given, strict=True))
        return [tensor for of in found for tensor in (of.image, of.alpha, of.radii)]

    found = in_both_orders(emulation, lambda library: drawn(partial(cuda_picture.draw_views, library)))
    for ours, theirs in zip(found, drawn(cpu.draw_views), strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-5, atol=1e-6)
    (one,) = cuda_picture.draw_views(emulation(0), gaussians[:1], VIEWPORTS[:1])
    single = cuda_picture.rasterize(emulation(0), gaussians[0], VIEWPORTS[0])
    assert torch.equal(single.image, one.image)


@pytest.mark.parametrize("tiled", [False, True])
@pytest.mark.parametrize("filtered", [False, True])
def test_generated_gaussians(emulation: Callable[[int], KernelLibrary], tiled: bool, filtered: bool) -> None:
    cpu, shown, tiles = cpu_backend(), scene(filtered=filtered), selections(4) if tiled else None

    def of_views(backend: Backend) -> list[Gaussians]:
        return shown.gaussians_of_views(CAMERAS, backend, tiles=tiles)

    def run(library: KernelLibrary) -> list[Tensor]:
        kernels = cpu.with_functions(generate_views=partial(cuda_anchors.generate_views, library))
        return [column for gaussians in of_views(kernels) for column in gaussians.columns().values()]

    columns = list(of_views(cpu)[0].columns())
    found = in_both_orders(emulation, run)
    for n, theirs in enumerate(of_views(cpu)):
        every = Gaussians(**dict(zip(columns, found[n * len(columns) : (n + 1) * len(columns)], strict=True)))
        assert len(every) == 60 * shown.anchors.offsets_per_anchor + 3
        ours = every.select(every.opacities > 0)
        for name, column in theirs.columns().items():
            torch.testing.assert_close(getattr(ours, name), column, rtol=1e-4, atol=1e-6)


def test_reached_tiles(emulation: Callable[[int], KernelLibrary]) -> None:
    cpu, shown, cameras = cpu_backend(), scene(), [camera.scaled(4.0) for camera in CAMERAS]
    gaussians, like = shown.gaussians_of_views(cameras, cpu), torch.zeros(0)
    slots = 60 * shown.anchors.offsets_per_anchor + 3
    visible = torch.rand(len(cameras), slots, generator=torch.Generator().manual_seed(6)) < 0.05
    views = gaussians, [camera.viewport(like) for camera in cameras], visible
    options = {"reduced": [camera.scaled(0.25).viewport(like) for camera in cameras], "margin_pixels": 2}
    (found,) = in_both_orders(emulation, lambda library: [cuda_picture.reached_tiles(library, *views, **options)])
    assert torch.equal(found, cpu.reached_tiles(*views, **options))
    assert 0 < found.sum() < found.numel()


@pytest.mark.parametrize("terms", [0, 1, 4, 9])
def test_displayed_pictures(emulation: Callable[[int], KernelLibrary], terms: int) -> None:
    generator = torch.Generator().manual_seed(terms)
    image = 1.4 * torch.rand(*SIZE, 3, generator=generator) - 0.2
    alpha = torch.rand(*SIZE, generator=generator).where(torch.rand(*SIZE, generator=generator) < 0.7, 1.0)
    coefficients = torch.randn(terms, 3, generator=generator) if terms else None
    given = image, alpha, CAMERAS[1], coefficients
    (found,) = in_both_orders(emulation, lambda library: [cuda_picture.display(library, *given)])
    expected = reference_raster.display(*given)
    assert found.dtype == torch.uint8
    difference = (found.int() - expected.int()).abs()
    assert difference.max() <= 1  # where another order of the sum falls on the other side of a half
    assert (difference > 0).sum() <= 1e-3 * difference.numel()
    assert (found.amin(), found.amax()) == (0, 255)
