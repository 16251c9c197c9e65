# SPDX-License-Identifier: Apache-2.0
import torch

from structgstream.gaussians import Gaussians
from structgstream.scene.render import Rendering
from structgstream.training.losses import GradientStatistics


def rendering(ids: list[int], radii: list[float], *, width: int = 20, height: int = 10) -> Rendering:
    none = torch.zeros(len(ids), 3)
    gaussians = Gaussians(none, torch.zeros(len(ids), 4), none, none[:, 0], none, torch.tensor(ids))
    return Rendering(torch.zeros(height, width, 3), torch.zeros(height, width), torch.tensor(radii), gaussians, None)


def test_pixels_become_normalised_device_units() -> None:
    statistics = GradientStatistics(5, torch.device("cpu"))
    statistics.add(rendering([3], [1.0]), torch.tensor([[0.3, 0.8]]))
    # Half the picture's size a unit: (0.3 * 10, 0.8 * 5) has length 5.
    assert torch.allclose(statistics.mean(), torch.tensor([0.0, 0.0, 0.0, 5.0, 0.0]))


def test_means_are_over_the_renderings_that_drew_the_gaussian() -> None:
    statistics = GradientStatistics(3, torch.device("cpu"))
    statistics.add(rendering([0, 2], [1.0, 0.0]), torch.tensor([[0.1, 0.0], [9.0, 9.0]]))
    statistics.add(rendering([2, 0], [1.0, 1.0]), torch.tensor([[0.2, 0.0], [0.3, 0.0]]))
    assert torch.allclose(statistics.mean(), torch.tensor([2.0, 0.0, 2.0]))
    assert statistics.count.tolist() == [2.0, 0.0, 1.0]
