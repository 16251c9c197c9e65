# SPDX-License-Identifier: Apache-2.0
"""Losses and the optimiser's step of the reference, beside what is known by hand or published."""

import math

import pytest
import torch

from structgstream.kernels.reference_losses import change_bits, excess, l1_ssim, neighbour_difference, ssim_map, volume
from tests.support.published import published_ssim


def pictures() -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    target = torch.rand(40, 48, 3, generator=generator, dtype=torch.float64)
    return (target + 0.1 * torch.randn(40, 48, 3, generator=generator, dtype=torch.float64)).clamp(0, 1), target


def test_inside_the_border_it_is_the_published_ssim() -> None:
    image, target = pictures()
    reference = published_ssim(image, target)
    ours = ssim_map(image, target).numpy()
    assert abs(ours[6:-6, 6:-6] - reference[6:-6, 6:-6]).max() < 1e-9


def test_bytes_mean_the_same_as_floats() -> None:
    image, target = pictures()
    as_bytes = (target * 255).round().to(torch.uint8)
    l1, value = l1_ssim(image, as_bytes)
    assert value.item() == pytest.approx(ssim_map(image, as_bytes.double() / 255).mean().item())
    assert l1.item() == pytest.approx((image - as_bytes.double() / 255).abs().mean().item())


def test_the_gradient_of_ssim_by_finite_differences() -> None:
    image, target = pictures()
    small = image[:12, :12].clone().requires_grad_()
    assert torch.autograd.gradcheck(lambda x: l1_ssim(x, target[:12, :12])[1], (small,), atol=1e-6)


def test_volume_by_hand_with_its_gradient() -> None:
    """Volumes 6 and 1, of which one is seen; every volume counts in the sum, that of the hidden one too."""
    scales = torch.tensor([[1.0, 2.0, 3.0], [1.0, 1.0, 1.0]], requires_grad=True)
    total, seen = volume(scales, torch.tensor([0.5, 0.0]))
    assert (float(total.detach()), int(seen)) == (7.0, 1)
    total.backward()
    torch.testing.assert_close(scales.grad, torch.tensor([[6.0, 3.0, 2.0], [1.0, 1.0, 1.0]]))


def test_excess_by_hand_with_its_gradient() -> None:
    """Offsets of one anchor times scales 1, 2 and 1: 3 and -4 stray by 1 and 2 beyond a limit of 2, 1 does not."""
    offsets = torch.tensor([[[3.0, -2.0, 1.0]]], requires_grad=True)
    log_scales = torch.tensor([[0.0, math.log(2.0), 0.0]], requires_grad=True)
    found = excess(offsets, log_scales, 2.0)
    torch.testing.assert_close(found, torch.tensor(3.0))
    found.backward()
    torch.testing.assert_close(offsets.grad, torch.tensor([[[1.0, -2.0, 0.0]]]))
    torch.testing.assert_close(log_scales.grad, torch.tensor([[3.0, 4.0, 0.0]]))
    assert excess(offsets[:0], log_scales[:0], 2.0) == 0.0


def test_neighbour_difference_by_hand_with_its_gradient() -> None:
    """Two rows that are 3 along x and 4 along y apart, each the other's neighbour, and a slack of 12: 13 less 12."""
    values = torch.tensor([[0.0, 0.0, 1.0], [3.0, 4.0, 1.0]], requires_grad=True)
    found = neighbour_difference(values, torch.tensor([[1], [0]]), torch.tensor([[1.0], [0.5]]), slack=12.0)
    torch.testing.assert_close(found, torch.tensor(1.5))
    found.backward()
    expected = 1.5 * torch.tensor([[-3.0, -4.0, 0.0], [3.0, 4.0, 0.0]]) / 13.0
    torch.testing.assert_close(values.grad, expected)


def test_equal_rows_differ_by_nothing_and_have_no_gradient() -> None:
    values = torch.ones(3, 3, requires_grad=True)
    found = neighbour_difference(values, torch.tensor([[1], [2], [0]]), torch.ones(3, 1), slack=0.25)
    found.backward()
    assert found == 0.0
    assert values.grad is not None
    assert not values.grad.any()


def test_bits_of_changes_by_hand_with_its_gradient() -> None:
    """Three bins in one field are two bits, one bin in another is one, and what is as it was has none."""
    one = torch.tensor([[0.3, 0.0]], requires_grad=True)
    two = torch.tensor([-2.0], requires_grad=True)
    found = change_bits([one, two], [torch.zeros(1, 2), torch.tensor([-1.0])], [0.1, 1.0])
    torch.testing.assert_close(found, torch.tensor(3.0))
    found.backward()
    torch.testing.assert_close(one.grad, torch.tensor([[1.0 / (4 * 0.1 * math.log(2.0)), 0.0]]))
    torch.testing.assert_close(two.grad, torch.tensor([-1.0 / (2 * math.log(2.0))]))
