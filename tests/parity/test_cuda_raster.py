# SPDX-License-Identifier: Apache-2.0
"""The GPU's rasteriser with gradients beside the cpu back-end's and the float64 reference: its kernels run on the
processor, with threads and blocks in both orders, and on a GPU where there is one.
"""

from collections.abc import Callable
from functools import partial

import pytest
import torch
from torch import Tensor

from benchmarks.gpu import apart, drawn_with_gradients, rasterize_by_gsplat
from structgstream.cameras import Camera
from structgstream.errors import BackendError
from structgstream.kernels import cpu_raster, cuda_picture, reference_raster
from structgstream.kernels.cuda_library import KernelLibrary
from structgstream.kernels.values import TileSelection
from tests.parity.conftest import in_both_orders
from tests.parity.test_raster import (
    COLOURED,
    HEIGHT,
    NAMES,
    NEAR,
    WIDTH,
    camera,
    check_against_reference,
    check_nothing_broken_or_hidden_is_drawn,
    check_that_memory_is_freed_without_a_backward_pass,
    gaussians,
    intervals_at,
    run,
    run_tiles,
    some_tiles,
)
from tests.support.backends import needs_native
from tests.support.splats import splats_of

pytestmark = needs_native
DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.needs_cuda)]
Emulation = Callable[[int], KernelLibrary]


def scene(name: str) -> list[Tensor]:
    """Means, rotations, scales, opacities, colours and screen offsets, float32."""
    values = [value.float().clone() for value in gaussians(1500 if name == "dark" else 300)]
    if name == "dark":  # Many pixels stop early, most Gaussians are hidden.
        values[3] = 0.9 + 0.1 * values[3]
    elif name == "needles":
        values[2][:] = 0.004
        values[2][:, 0] = 0.5
    elif name == "walls":  # Larger than the picture.
        values[2] *= 500.0
    elif name == "moved":
        values[5] = torch.randn(300, 2, generator=torch.Generator().manual_seed(5)) * 8.0
    return values


@pytest.mark.parametrize("name", ["plain", "dark", "needles", "walls", "moved"])
@pytest.mark.parametrize("background", [None, COLOURED], ids=["black", "coloured"])
@pytest.mark.parametrize("share", [None, 0.4])
def test_pictures_and_gradients_are_those_of_the_cpu(
    emulation: Emulation, name: str, background: Tensor | None, share: float | None
) -> None:
    inputs = scene(name)
    intervals = None if share is None else intervals_at(share)[:1].expand(len(inputs[0]))
    options = {"background": background, "intervals": intervals, "away": torch.ones(HEIGHT, WIDTH)}

    def results(library: KernelLibrary) -> list[Tensor]:
        image, alpha, gradients, radii = run(partial(cuda_picture.rasterize, library), tuple(inputs), **options)
        return [image, alpha, radii, *gradients]

    image, alpha, radii, *gradients = in_both_orders(emulation, results)
    exact, exact_alpha, exact_gradients, exact_radii = run(cpu_raster.rasterize, tuple(inputs), **options)
    # In pixels where an alpha is at a limit, the last bit decides. Conics of needles have large roundings.
    apart = torch.maximum((image - exact).abs().amax(-1), (alpha - exact_alpha).abs())
    assert (apart < (3e-5 if name == "needles" else 1e-6)).float().mean() > 0.999
    torch.testing.assert_close(radii, exact_radii, rtol=1e-4, atol=1e-4)
    for ours, theirs, attribute in zip(gradients, exact_gradients, NAMES, strict=True):
        assert theirs.any(), attribute
        assert (ours - theirs).norm() <= 1e-3 * theirs.norm(), attribute


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("background", [None, COLOURED], ids=["black", "coloured"])
@pytest.mark.parametrize("share", [None, 0.0, 0.4, 1.0, 3.0])
def test_the_reference(
    kernels_on: Callable[[str], KernelLibrary], device: str, background: Tensor | None, share: float | None
) -> None:
    rasterize = partial(cuda_picture.rasterize, kernels_on(device))
    check_against_reference(rasterize, background=background, device=device, share=share)


@pytest.mark.parametrize("trained", [None, 0, 120])
@pytest.mark.parametrize("tiles", [None, some_tiles()], ids=["whole", "tiles"])
def test_tiles_and_trained_rows(emulation: Emulation, trained: int | None, tiles: TileSelection | None) -> None:
    inputs = tuple(value.float() for value in gaussians())
    results = []
    for rasterize in (cpu_raster.rasterize, *(partial(cuda_picture.rasterize, emulation(order)) for order in (0, 1))):
        onto = None if tiles is None else torch.rand(HEIGHT, WIDTH, 3, generator=torch.Generator().manual_seed(1))
        output, gradients = run_tiles(rasterize, inputs, tiles, onto, trained)
        assert onto is None or output.image.data_ptr() == onto.data_ptr()
        assert onto is None or not onto.requires_grad
        results.append([output.image.detach(), output.alpha.detach(), output.radii, *gradients])
    exact, ours, again = results
    assert all(torch.equal(one, two) for one, two in zip(ours, again, strict=True))
    for found, theirs in zip(ours[:3], exact[:3], strict=True):
        torch.testing.assert_close(found, theirs, rtol=1e-4, atol=2e-6)
    for found, theirs in zip(ours[3:], exact[3:], strict=True):
        assert (found - theirs).norm() <= 1e-3 * theirs.norm()
        assert trained is None or not found[trained:].any()
        assert theirs.any() or trained == 0


@pytest.mark.parametrize("part", ["image", "alpha"])
def test_only_the_picture_or_only_coverage_has_a_gradient(emulation: Emulation, part: str) -> None:
    inputs = [value.float() for value in gaussians()[:5]]
    found = []
    for rasterize in (cpu_raster.rasterize, partial(cuda_picture.rasterize, emulation(0))):
        leaves = [value.clone().requires_grad_() for value in inputs]
        output = rasterize(splats_of(*leaves), camera(torch.float32), background=COLOURED)
        assert not output.radii.requires_grad
        found.append(torch.autograd.grad(getattr(output, part).square().sum(), leaves))
    for theirs, ours in zip(*found, strict=True):
        assert (ours - theirs).norm() <= 1e-4 * theirs.norm()
    assert found[0][0].any()


@pytest.mark.parametrize("order", [0, 1])
def test_nothing_broken_or_hidden_is_drawn(emulation: Emulation, order: int) -> None:
    check_nothing_broken_or_hidden_is_drawn(partial(cuda_picture.rasterize, emulation(order)))


def test_memory_is_freed_without_a_backward_pass(emulation: Emulation) -> None:
    check_that_memory_is_freed_without_a_backward_pass(partial(cuda_picture.rasterize, emulation(0)))


def test_another_precision_is_refused_and_a_changed_input_is_found(emulation: Emulation) -> None:
    leaves = [value.requires_grad_() for value in map(torch.clone, gaussians(3)[:5])]
    with pytest.raises(BackendError, match="reference back-end"):
        cuda_picture.rasterize(emulation(0), splats_of(*leaves), camera())
    single = [value.detach().float().requires_grad_() for value in leaves]
    output = cuda_picture.rasterize(emulation(0), splats_of(*single), camera(torch.float32))
    with torch.no_grad():
        single[3].mul_(0.5)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        output.image.sum().backward()


def test_weights_are_gradients_of_colours(emulation: Emulation) -> None:
    given = splats_of(*(value.float() for value in gaussians()[:5]))
    maps = torch.rand(HEIGHT, WIDTH, 5, generator=torch.Generator().manual_seed(3))
    rasterize = partial(cuda_picture.rasterize, emulation(0))
    view = camera(torch.float32)
    (weights,) = cuda_picture.weigh_views(emulation(0), [given], [view], maps[None], slots=len(given.means))
    again = reference_raster.weights_by_gradient(rasterize, given, view, maps)
    assert (weights - again).norm() <= 1e-6 * weights.norm()


@pytest.mark.needs_cuda
def test_gsplat_draws_the_same(kernels_on: Callable[[str], KernelLibrary]) -> None:
    pytest.importorskip("gsplat")
    given, view = splats_of(*(value.float().cuda() for value in gaussians()[:5])), camera()
    ours, theirs = (
        drawn_with_gradients(rasterize, given, Camera(view.viewmat, view.K, WIDTH, HEIGHT, NEAR))
        for rasterize in (partial(cuda_picture.rasterize, kernels_on("cuda")), rasterize_by_gsplat)
    )
    picture, gradient = apart(ours, theirs)
    assert picture < 1e-4
    assert gradient < 0.02  # gsplat has gradients where hardly any light arrives, too.
