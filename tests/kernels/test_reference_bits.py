# SPDX-License-Identifier: Apache-2.0
import math

import torch

from structgstream.kernels.reference_bits import change_bits


def test_by_hand_with_its_gradient() -> None:
    """Three bins in one field are two bits, one bin in another is one, and what is as it was has none."""
    one = torch.tensor([[0.3, 0.0]], requires_grad=True)
    two = torch.tensor([-2.0], requires_grad=True)
    found = change_bits([one, two], [torch.zeros(1, 2), torch.tensor([-1.0])], [0.1, 1.0])
    torch.testing.assert_close(found, torch.tensor(3.0))
    found.backward()
    torch.testing.assert_close(one.grad, torch.tensor([[1.0 / (4 * 0.1 * math.log(2.0)), 0.0]]))
    torch.testing.assert_close(two.grad, torch.tensor([-1.0 / (2 * math.log(2.0))]))
