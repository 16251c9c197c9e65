# SPDX-License-Identifier: Apache-2.0
"""The GPU's loss beside its oracle in float64: its phases run on the processor, thread after thread, and, where there
is a GPU, the kernels themselves.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import pytest
import torch
from torch import Tensor

from structgstream.errors import BackendError
from structgstream.kernels import cpu_losses, cuda, reference_losses
from structgstream.kernels.cuda_library import KernelLibrary
from structgstream.kernels.native import native_reason
from structgstream.kernels.values import TileSelection, tile_grid

Loss = Callable[..., tuple[Tensor, Tensor]]


@pytest.fixture(params=["emulated", pytest.param("cuda", marks=pytest.mark.needs_cuda)])
def loss(request: pytest.FixtureRequest) -> Loss:
    """``l1_ssim``, of the emulation or of a GPU; it takes and gives tensors of the processor."""
    if request.param == "emulated":
        return partial(cuda.l1_ssim, request.getfixturevalue("emulation")(0))
    from structgstream.kernels.backend import cuda_backend

    backend = cuda_backend()
    assert backend.l1_ssim is not reference_losses.l1_ssim, "the kernels were not compiled"

    def on_gpu(value: Any) -> Any:
        if isinstance(value, TileSelection):
            return replace(value, mask=value.mask.cuda())
        return None if value is None else value.cuda()

    def there(image: Tensor, target: Tensor, **options: Any) -> tuple[Tensor, Tensor]:
        moved = {name: on_gpu(value) for name, value in options.items()}
        l1, ssim = backend.l1_ssim(image.cuda(), target.cuda(), **moved)
        return l1.cpu(), ssim.cpu()

    return there


def pictures(height: int, width: int, *, as_bytes: bool = False) -> tuple[Tensor, Tensor]:
    """A noisy copy, and a smooth picture as floats or bytes."""
    rough = torch.rand(3, height, width)
    target = torch.nn.functional.avg_pool2d(rough, 5, 1, 2).permute(1, 2, 0).contiguous()
    image = (target + 0.05 * torch.randn(height, width, 3)).clamp(0, 1)
    return image, (target * 255).round().to(torch.uint8) if as_bytes else target


def value_and_gradient(
    loss: Loss, image: Tensor, target: Tensor, weights: tuple[float, float], **options: Any
) -> tuple[Tensor, Tensor, Tensor]:
    image = image.clone().requires_grad_()
    l1, ssim = loss(image, target, **options)
    (gradient,) = torch.autograd.grad(weights[0] * l1 + weights[1] * ssim, image)
    return l1.detach(), ssim.detach(), gradient


def exactly(target: Tensor) -> Tensor:
    return target if target.dtype == torch.uint8 else target.double()


# One row, one pixel, less than a window, whole tiles, an odd size, many tiles across.
@pytest.mark.parametrize("size", [(1, 23), (1, 1), (7, 5), (32, 48), (37, 29), (24, 300)])
@pytest.mark.parametrize("as_bytes", [False, True])
def test_value_and_gradient(loss: Loss, size: tuple[int, int], as_bytes: bool) -> None:
    image, target = pictures(*size, as_bytes=as_bytes)
    for weights in [(0.0, 1.0), (1.0, -0.2)]:
        l1, ssim, gradient = value_and_gradient(loss, image, target, weights)
        exact_l1, exact_ssim, exact = value_and_gradient(
            reference_losses.l1_ssim, image.double(), exactly(target), weights
        )
        assert abs(l1.double() - exact_l1) < 1e-6
        assert abs(ssim.double() - exact_ssim) < 1e-6
        assert (gradient - exact).norm() < 1e-5 * exact.norm()


@pytest.mark.parametrize("tiled", [False, True])
def test_a_corrected_picture_and_some_of_its_tiles(loss: Loss, tiled: bool) -> None:
    image, target = pictures(75, 110, as_bytes=True)
    gains, biases = torch.tensor([1.1, 0.9, 1.05]), torch.tensor([0.02, -0.03, 0.01])
    tiles = TileSelection(torch.rand(tile_grid(110, 75)) < 0.3, 110, 75) if tiled else None
    l1, ssim, gradient = value_and_gradient(loss, image, target, (1.0, -0.2), gains=gains, biases=biases, tiles=tiles)
    exact_options = {"gains": gains.double(), "biases": biases.double()}
    oracle = partial(value_and_gradient, reference_losses.l1_ssim, image.double(), target, (1.0, -0.2), **exact_options)
    exact_l1, exact_ssim, exact = oracle(tiles=tiles)
    assert abs(l1.double() - exact_l1) < 1e-6
    assert abs(ssim.double() - exact_ssim) < 1e-6
    assert (gradient - exact).norm() < 1e-5 * exact.norm()
    assert tiles is None or not gradient[~tiles.pixels()].any()


@pytest.mark.skipif(native_reason() is not None, reason=str(native_reason()))
def test_tiles_mean_the_same_as_on_the_cpu(loss: Loss) -> None:
    image, target = pictures(60, 90, as_bytes=True)
    tiles = TileSelection(torch.zeros(tile_grid(90, 60), dtype=torch.bool), 90, 60)
    tiles.mask[1, 2] = tiles.mask[3, 5] = True
    ours = value_and_gradient(loss, image, target, (1.0, -0.2), tiles=tiles)
    theirs = value_and_gradient(cpu_losses.l1_ssim, image, target, (1.0, -0.2), tiles=tiles)
    assert all(torch.allclose(a, b, rtol=1e-4, atol=1e-8) for a, b in zip(ours, theirs, strict=True))


def test_no_gradient_is_asked_for(loss: Loss) -> None:
    image, target = pictures(40, 40)
    tiles = TileSelection(torch.rand(tile_grid(40, 40)) < 0.5, 40, 40)
    with torch.no_grad():
        for chosen in (None, tiles):
            l1, ssim = loss(image, target, tiles=chosen)
            exact = reference_losses.l1_ssim(image, target, tiles=chosen)
            assert torch.allclose(torch.stack([l1, ssim]), torch.stack(exact), atol=1e-6)


def test_equal_pictures_score_one_and_pull_nowhere(loss: Loss) -> None:
    image, _ = pictures(20, 20)
    l1, ssim, gradient = value_and_gradient(loss, image, image.clone(), (1.0, -1.0))
    assert l1 == 0.0
    assert ssim.item() == pytest.approx(1.0, abs=1e-6)
    assert gradient.abs().max() < 1e-6


def test_repeats_bit_for_bit(loss: Loss) -> None:
    image, target = pictures(45, 120)
    first, second = (value_and_gradient(loss, image, target, (0.8, -0.2)) for _ in range(2))
    assert all(torch.equal(a, b) for a, b in zip(first, second, strict=True))


def test_within_a_phase_threads_may_run_in_any_order(emulation: Callable[[int], KernelLibrary]) -> None:
    image, target = pictures(45, 120)
    tiles = TileSelection(torch.rand(tile_grid(120, 45)) < 0.5, 120, 45)
    forth, back = (
        value_and_gradient(partial(cuda.l1_ssim, emulation(order)), image, target, (0.8, -0.2), tiles=tiles)
        for order in (0, 1)
    )
    assert all(torch.equal(a, b) for a, b in zip(forth, back, strict=True))


def test_what_it_cannot_compare(loss: Loss, emulation: Callable[[int], KernelLibrary]) -> None:
    image, target = pictures(8, 8)
    with pytest.raises(BackendError, match="float64"):
        loss(image.double(), target)
    with pytest.raises(BackendError, match=r"\(8, 7, 3\)"):
        loss(image, target[:, :7])
    with pytest.raises(BackendError, match="not on meta"):
        cuda.l1_ssim(emulation(0), image, target.to("meta"))
