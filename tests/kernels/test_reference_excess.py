# SPDX-License-Identifier: Apache-2.0
import math

import torch

from structgstream.kernels.reference_excess import excess


def test_by_hand_with_its_gradient() -> None:
    """Offsets of one anchor times scales 1, 2 and 1: 3 and -4 stray by 1 and 2 beyond a limit of 2, 1 does not."""
    offsets = torch.tensor([[[3.0, -2.0, 1.0]]], requires_grad=True)
    log_scales = torch.tensor([[0.0, math.log(2.0), 0.0]], requires_grad=True)
    found = excess(offsets, log_scales, 2.0)
    torch.testing.assert_close(found, torch.tensor(3.0))
    found.backward()
    torch.testing.assert_close(offsets.grad, torch.tensor([[[1.0, -2.0, 0.0]]]))
    torch.testing.assert_close(log_scales.grad, torch.tensor([[3.0, 4.0, 0.0]]))
    assert excess(offsets[:0], log_scales[:0], 2.0) == 0.0
