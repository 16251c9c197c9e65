# SPDX-License-Identifier: Apache-2.0
import torch

from structgstream.kernels.reference_neighbours import neighbour_difference


def test_by_hand_with_its_gradient() -> None:
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
