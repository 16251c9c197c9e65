# SPDX-License-Identifier: Apache-2.0
import torch

from structgstream.scene.color import CameraColor


def test_the_gauge_is_exact_and_keeps_differences() -> None:
    color = CameraColor(gains=torch.rand(5, 3) + 0.5, biases=torch.rand(5, 3) - 0.5)
    gauged = color.gauged()
    assert torch.allclose(gauged.gains.mean(0), torch.ones(3))
    assert torch.allclose(gauged.biases.mean(0), torch.zeros(3), atol=1e-6)
    assert torch.allclose(gauged.gains[1] - gauged.gains[0], color.gains[1] - color.gains[0])
