# SPDX-License-Identifier: Apache-2.0
import torch

from structgstream.kernels.reference_change import changed_pixels


def test_what_changed_and_its_surroundings() -> None:
    before = torch.full((20, 30, 3), 100, dtype=torch.uint8)
    now = before.clone()
    now[10, 15] = 190  # 90 / 255 over nine pixels: a mean of 0.039
    assert not changed_pixels(before, now, threshold=0.04, reach_pixels=2).any()
    found = changed_pixels(before, now, threshold=0.035, reach_pixels=0)
    assert found.sum() == 9
    assert found[9:12, 14:17].all()
    assert changed_pixels(before, now, threshold=0.035, reach_pixels=2)[7:14, 12:19].all()


def test_darker_is_a_change_as_brighter_is_and_a_corner_has_fewer_neighbours() -> None:
    before = torch.full((8, 8, 3), 100, dtype=torch.uint8)
    now = before.clone()
    now[0, 0] = 30  # 70 / 255 over four pixels
    assert changed_pixels(before, now, threshold=0.06, reach_pixels=0).sum() == 1
