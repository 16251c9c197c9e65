# SPDX-License-Identifier: Apache-2.0
"""The C++ loss beside its oracle in float64."""

import pytest
import torch
from torch import Tensor

from structgstream.errors import BackendError
from structgstream.kernels import cpu_losses, reference_losses
from structgstream.kernels.native import native_reason
from structgstream.kernels.values import TileSelection, tile_grid

pytestmark = pytest.mark.skipif(native_reason() is not None, reason=str(native_reason()))


def pictures(height: int, width: int) -> tuple[Tensor, Tensor]:
    """A smooth picture and a noisy copy."""
    rough = torch.rand(3, height, width)
    target = torch.nn.functional.avg_pool2d(rough, 5, 1, 2).permute(1, 2, 0).contiguous()
    return (target + 0.05 * torch.randn(height, width, 3)).clamp(0, 1), target


def value_and_gradient(module, image: Tensor, target: Tensor, weights: tuple[float, float]) -> tuple[Tensor, ...]:
    image = image.clone().requires_grad_()
    l1, ssim = module.l1_ssim(image, target)
    (gradient,) = torch.autograd.grad(weights[0] * l1 + weights[1] * ssim, image)
    return l1.detach(), ssim.detach(), gradient


# One row, one pixel, less than a window, an odd size, more than one strip of columns.
@pytest.mark.parametrize("size", [(1, 23), (1, 1), (7, 5), (37, 29), (24, 600)])
@pytest.mark.parametrize("as_bytes", [False, True])
def test_value_and_gradient(isa: int, size: tuple[int, int], as_bytes: bool) -> None:
    image, target = pictures(*size)
    if as_bytes:
        target = (target * 255).round().to(torch.uint8)
    exact_target = target if as_bytes else target.double()
    for weights in [(0.0, 1.0), (1.0, -0.2)]:
        l1, ssim, gradient = value_and_gradient(cpu_losses, image, target, weights)
        exact_l1, exact_ssim, exact = value_and_gradient(reference_losses, image.double(), exact_target, weights)
        assert abs(l1.double() - exact_l1) < 1e-6
        assert abs(ssim.double() - exact_ssim) < 1e-6
        assert (gradient - exact).norm() < 1e-5 * exact.norm()


def test_bitwise_equal_for_any_number_of_threads(isa: int) -> None:
    image, target = pictures(45, 320)
    results = []
    for threads in (1, 2, 3, 2):
        torch.set_num_threads(threads)
        results.append(value_and_gradient(cpu_losses, image, target, (0.8, -0.2)))
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


def test_equal_pictures_score_one_and_pull_nowhere() -> None:
    image, _ = pictures(20, 20)
    l1, ssim, gradient = value_and_gradient(cpu_losses, image, image.clone(), (1.0, -1.0))
    assert l1 == 0.0
    assert ssim.item() == pytest.approx(1.0, abs=1e-6)
    assert gradient.abs().max() < 1e-6


def test_a_picture_that_is_not_contiguous() -> None:
    image, target = pictures(20, 24)
    turned = image.permute(1, 0, 2).contiguous().permute(1, 0, 2)
    assert torch.equal(cpu_losses.l1_ssim(turned, target)[1], cpu_losses.l1_ssim(image, target)[1])


def test_what_it_cannot_compare() -> None:
    image, target = pictures(8, 8)
    with pytest.raises(BackendError, match="float64"):
        cpu_losses.l1_ssim(image.double(), target)
    with pytest.raises(BackendError, match=r"\(8, 7, 3\)"):
        cpu_losses.l1_ssim(image, target[:, :7])


@pytest.mark.parametrize("as_bytes", [False, True])
@pytest.mark.parametrize("tiled", [False, True])
def test_a_corrected_picture_and_some_of_its_tiles(isa: int, as_bytes: bool, tiled: bool) -> None:
    image, target = pictures(75, 310)
    if as_bytes:
        target = (target * 255).round().to(torch.uint8)
    gains, biases = torch.tensor([1.1, 0.9, 1.05]), torch.tensor([0.02, -0.03, 0.01])
    tiles = TileSelection(torch.rand(tile_grid(310, 75)) < 0.4, 310, 75) if tiled else None

    def run(module, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        x = x.clone().requires_grad_()
        l1, ssim = module.l1_ssim(x, y, gains=gains.to(x), biases=biases.to(x), tiles=tiles)
        return l1.detach(), ssim.detach(), torch.autograd.grad(l1 - 0.2 * ssim, x)[0]

    l1, ssim, gradient = run(cpu_losses, image, target)
    exact_l1, exact_ssim, exact = run(reference_losses, image.double(), target if as_bytes else target.double())
    assert abs(l1.double() - exact_l1) < 1e-6
    assert abs(ssim.double() - exact_ssim) < 1e-6
    assert (gradient - exact).norm() < 1e-5 * exact.norm()
    if tiles is None:
        return
    # In the tiles the gradient is that of the whole picture: what the other tiles' windows say is part of it.
    inside = tiles.pixels()
    whole = run_whole(image.double(), target, gains, biases)
    assert torch.equal(exact[inside], whole[inside])
    assert not exact[~inside].any()
    assert not gradient[~inside].any()


def run_whole(image: Tensor, target: Tensor, gains: Tensor, biases: Tensor) -> Tensor:
    image = image.clone().requires_grad_()
    exact_target = target if target.dtype == torch.uint8 else target.double()
    l1, ssim = reference_losses.l1_ssim(image, exact_target, gains=gains.double(), biases=biases.double())
    return torch.autograd.grad(l1 - 0.2 * ssim, image)[0]


def test_tiles_do_not_depend_on_threads() -> None:
    image, target = pictures(90, 200)
    tiles = TileSelection(torch.rand(tile_grid(200, 90)) < 0.5, 200, 90)
    results = []
    for threads in (1, 2, 3):
        torch.set_num_threads(threads)
        x = image.clone().requires_grad_()
        l1, ssim = cpu_losses.l1_ssim(x, target, tiles=tiles)
        results.append((l1, ssim, *torch.autograd.grad(l1 + ssim, x)))
    torch.set_num_threads(1)
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))
