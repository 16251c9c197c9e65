# SPDX-License-Identifier: Apache-2.0
import torch

from structgstream.kernels.reference_volume import volume


def test_by_hand_with_its_gradient() -> None:
    """Volumes 6 and 1, of which one is seen; every volume counts in the sum, that of the hidden one too."""
    scales = torch.tensor([[1.0, 2.0, 3.0], [1.0, 1.0, 1.0]], requires_grad=True)
    total, seen = volume(scales, torch.tensor([0.5, 0.0]))
    assert (float(total.detach()), int(seen)) == (7.0, 1)
    total.backward()
    torch.testing.assert_close(scales.grad, torch.tensor([[6.0, 3.0, 2.0], [1.0, 1.0, 1.0]]))
