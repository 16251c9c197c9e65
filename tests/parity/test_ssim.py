# SPDX-License-Identifier: Apache-2.0
"""The loss in C++ and in CUDA beside its oracle in float64. The phases of the CUDA kernels run on the processor, thread
after thread, and, where there is a GPU, the kernels themselves.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import pytest
import torch
from torch import Tensor

from structgstream.errors import BackendError
from structgstream.kernels import cpu_losses, cuda, reference_losses
from structgstream.kernels.cuda_library import KernelLibrary
from structgstream.kernels.native import ISA_NAMES
from structgstream.kernels.values import TileSelection, tile_grid
from tests.parity.conftest import check_any_threads, in_both_orders, using_isa

Loss = Callable[..., tuple[Tensor, Tensor]]


@pytest.fixture(params=[*ISA_NAMES, "emulated", pytest.param("cuda", marks=pytest.mark.needs_cuda)])
def loss(request: pytest.FixtureRequest) -> Iterator[Loss]:
    """``l1_ssim`` of C++ with an instruction set, of the emulation or of a GPU; it takes and gives tensors of the
    processor."""
    if request.param in ISA_NAMES:
        with using_isa(ISA_NAMES.index(request.param)):
            yield cpu_losses.l1_ssim
    elif request.param == "emulated":
        yield partial(cuda.l1_ssim, request.getfixturevalue("emulation")(0))
    else:
        yield on_gpu


def on_gpu(image: Tensor, target: Tensor, **options: Any) -> tuple[Tensor, Tensor]:
    from structgstream.kernels.backend import cuda_backend

    def moved(value: Any) -> Any:
        if isinstance(value, TileSelection):
            return replace(value, mask=value.mask.cuda())
        return None if value is None else value.cuda()

    backend = cuda_backend()
    assert backend.l1_ssim is not reference_losses.l1_ssim, "the kernels were not compiled"
    given = {name: moved(value) for name, value in options.items()}
    l1, ssim = backend.l1_ssim(image.cuda(), target.cuda(), **given)
    return l1.cpu(), ssim.cpu()


def pictures(height: int, width: int, *, as_bytes: bool = False) -> tuple[Tensor, Tensor]:
    """A noisy copy, and a smooth picture as floats or bytes."""
    rough = torch.rand(3, height, width)
    target = torch.nn.functional.avg_pool2d(rough, 5, 1, 2).permute(1, 2, 0).contiguous()
    image = (target + 0.05 * torch.randn(height, width, 3)).clamp(0, 1)
    return image, (target * 255).round().to(torch.uint8) if as_bytes else target


def some_tiles(height: int, width: int) -> TileSelection:
    return TileSelection(torch.rand(tile_grid(width, height)) < 0.4, width, height)


def value_and_gradient(
    loss: Loss, image: Tensor, target: Tensor, weights: tuple[float, float], **options: Any
) -> tuple[Tensor, Tensor, Tensor]:
    image = image.clone().requires_grad_()
    l1, ssim = loss(image, target, **options)
    (gradient,) = torch.autograd.grad(weights[0] * l1 + weights[1] * ssim, image)
    return l1.detach(), ssim.detach(), gradient


def exactly(image: Tensor, target: Tensor, weights: tuple[float, float], **options: Any) -> tuple[Tensor, ...]:
    """:func:`value_and_gradient` of the oracle."""
    exact_target = target if target.dtype == torch.uint8 else target.double()
    return value_and_gradient(reference_losses.l1_ssim, image.double(), exact_target, weights, **options)


def compare(ours: tuple[Tensor, ...], exact: tuple[Tensor, ...]) -> None:
    assert abs(ours[0].double() - exact[0]) < 1e-6
    assert abs(ours[1].double() - exact[1]) < 1e-6
    assert (ours[2] - exact[2]).norm() < 1e-5 * exact[2].norm()


# One row, one pixel, less than a window, whole tiles, an odd size, more than one strip of columns.
@pytest.mark.parametrize("size", [(1, 23), (1, 1), (7, 5), (32, 48), (37, 29), (24, 600)])
@pytest.mark.parametrize("as_bytes", [False, True])
def test_value_and_gradient(loss: Loss, size: tuple[int, int], as_bytes: bool) -> None:
    image, target = pictures(*size, as_bytes=as_bytes)
    for weights in [(0.0, 1.0), (1.0, -0.2)]:
        compare(value_and_gradient(loss, image, target, weights), exactly(image, target, weights))


@pytest.mark.parametrize("as_bytes", [False, True])
@pytest.mark.parametrize("tiled", [False, True])
def test_a_corrected_picture_and_some_of_its_tiles(loss: Loss, as_bytes: bool, tiled: bool) -> None:
    image, target = pictures(75, 310, as_bytes=as_bytes)
    gains, biases = torch.tensor([1.1, 0.9, 1.05]), torch.tensor([0.02, -0.03, 0.01])
    tiles = some_tiles(75, 310) if tiled else None
    found = value_and_gradient(loss, image, target, (1.0, -0.2), gains=gains, biases=biases, tiles=tiles)
    oracle = partial(exactly, image, target, (1.0, -0.2), gains=gains.double(), biases=biases.double())
    exact = oracle(tiles=tiles)
    compare(found, exact)
    if tiles is None:
        return
    # In the tiles the gradient is that of the whole picture: what the other tiles' windows say is part of it.
    inside = tiles.pixels()
    assert torch.equal(exact[2][inside], oracle()[2][inside])
    assert not exact[2][~inside].any()
    assert not found[2][~inside].any()


def test_no_gradient_is_asked_for(loss: Loss) -> None:
    image, target = pictures(40, 40)
    with torch.no_grad():
        for chosen in (None, some_tiles(40, 40)):
            found = torch.stack(loss(image, target, tiles=chosen))
            exact = torch.stack(reference_losses.l1_ssim(image, target, tiles=chosen))
            assert torch.allclose(found, exact, atol=1e-6)


def test_equal_pictures_score_one_and_pull_nowhere(loss: Loss) -> None:
    image, _ = pictures(20, 20)
    l1, ssim, gradient = value_and_gradient(loss, image, image.clone(), (1.0, -1.0))
    assert l1 == 0.0
    assert ssim.item() == pytest.approx(1.0, abs=1e-6)
    assert gradient.abs().max() < 1e-6


def test_a_picture_that_is_not_contiguous_gives_the_same_bits(loss: Loss) -> None:
    image, target = pictures(45, 120)
    turned = image.permute(1, 0, 2).contiguous().permute(1, 0, 2)
    first, second = (value_and_gradient(loss, given, target, (0.8, -0.2)) for given in (image, turned))
    assert all(torch.equal(a, b) for a, b in zip(first, second, strict=True))


@pytest.mark.parametrize("tiled", [False, True])
def test_bitwise_equal_for_any_number_of_threads(isa: int, tiled: bool) -> None:
    image, target = pictures(90, 320)
    given, tiles = (image, target, (0.8, -0.2)), some_tiles(90, 320) if tiled else None
    check_any_threads(lambda: value_and_gradient(cpu_losses.l1_ssim, *given, tiles=tiles), (1, 2, 3, 2))


def test_within_a_phase_threads_may_run_in_any_order(emulation: Callable[[int], KernelLibrary]) -> None:
    given, tiles = (*pictures(45, 120), (0.8, -0.2)), some_tiles(45, 120)
    in_both_orders(emulation, lambda library: value_and_gradient(partial(cuda.l1_ssim, library), *given, tiles=tiles))


def test_what_it_cannot_compare(loss: Loss) -> None:
    image, target = pictures(8, 8)
    with pytest.raises(BackendError, match="float64"):
        loss(image.double(), target)
    with pytest.raises(BackendError, match=r"\(8, 7, 3\)"):
        loss(image, target[:, :7])


def test_pictures_on_another_device_are_refused(emulation: Callable[[int], KernelLibrary]) -> None:
    image, target = pictures(8, 8)
    with pytest.raises(BackendError, match="not on meta"):
        cuda.l1_ssim(emulation(0), image, target.to("meta"))
