# SPDX-License-Identifier: Apache-2.0
import torch

from structgstream.scene.free import FreeGaussians
from tests.support.rigs import random_scene


def test_rows_keep_their_identity() -> None:
    free = random_scene(free=5).free
    kept = free.select(torch.tensor([True, False, True, False, True]))
    assert kept.births.tolist() == [0, 2, 4]
    assert torch.equal(kept.means, free.means[::2])
    both = kept.append(free)
    assert len(both) == 8
    assert both.births.tolist() == [0, 2, 4, 0, 1, 2, 3, 4]


def test_empty() -> None:
    assert len(FreeGaussians.empty()) == 0
    assert FreeGaussians.empty(torch.zeros(1, dtype=torch.float64)).quats.shape == (0, 4)
