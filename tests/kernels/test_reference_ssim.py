# SPDX-License-Identifier: Apache-2.0
import pytest
import torch

from published import published_ssim
from structgstream.kernels.reference_ssim import l1_ssim, ssim, ssim_map, window


def pictures() -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    target = torch.rand(40, 48, 3, generator=generator, dtype=torch.float64)
    return (target + 0.1 * torch.randn(40, 48, 3, generator=generator, dtype=torch.float64)).clamp(0, 1), target


def test_inside_the_border_it_is_the_published_ssim() -> None:
    image, target = pictures()
    reference = published_ssim(image, target)
    ours = ssim_map(image, target).numpy()
    assert abs(ours[6:-6, 6:-6] - reference[6:-6, 6:-6]).max() < 1e-9


def test_identical_pictures_score_one() -> None:
    image, _ = pictures()
    assert ssim(image, image).item() == pytest.approx(1.0)


def test_bytes_mean_the_same_as_floats() -> None:
    image, target = pictures()
    as_bytes = (target * 255).round().to(torch.uint8)
    l1, value = l1_ssim(image, as_bytes)
    assert value.item() == pytest.approx(ssim(image, as_bytes.double() / 255).item())
    assert l1.item() == pytest.approx((image - as_bytes.double() / 255).abs().mean().item())


def test_the_window_is_normalised_and_symmetric() -> None:
    weights = window(torch.zeros(1, dtype=torch.float64))
    assert weights.sum().item() == pytest.approx(1.0)
    assert torch.equal(weights, weights.flip(0))


def test_gradient_by_finite_differences() -> None:
    image, target = pictures()
    small = image[:12, :12].clone().requires_grad_()
    assert torch.autograd.gradcheck(lambda x: ssim(x, target[:12, :12]), (small,), atol=1e-6)
