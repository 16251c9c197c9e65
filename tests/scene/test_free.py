# SPDX-License-Identifier: Apache-2.0
import torch

from tests.support.rigs import random_scene


def test_rows_keep_their_identity() -> None:
    free = random_scene(free=5).free
    kept = free.select(torch.tensor([True, False, True, False, True]))
    assert kept.births.tolist() == [0, 2, 4]
    assert torch.equal(kept.means, free.means[::2])
    both = kept.append(free)
    assert len(both) == 8
    assert both.births.tolist() == [0, 2, 4, 0, 1, 2, 3, 4]
