# SPDX-License-Identifier: Apache-2.0
from collections.abc import Iterator, Mapping

import numpy as np
import torch

from rigs import arc_rig
from structgstream.frames import MultiViewFrame
from structgstream.training.views import View, reduced, shuffled_views, training_views


class Guarded(Mapping[str, np.ndarray]):
    """Pictures that refuse to be read for held-out cameras."""

    def __init__(self, held_out: frozenset[str]) -> None:
        self.held_out = held_out

    def __getitem__(self, name: str) -> np.ndarray:
        assert name not in self.held_out, f"{name} is held out"
        return np.full((32, 48, 3), 7, dtype=np.uint8)

    def __iter__(self) -> Iterator[str]:
        return iter(())

    def __len__(self) -> int:
        return 0


def test_held_out_pictures_are_never_read() -> None:
    rig = arc_rig()
    views = training_views(MultiViewFrame(0, 0.0, Guarded(rig.held_out)), rig, torch.device("cpu"))
    assert [view.index for view in views] == [0, 1, 2]


def test_every_view_comes_once_before_any_comes_twice() -> None:
    camera = arc_rig()["cam01"]
    views = [View(i, camera, torch.zeros(1)) for i in range(5)]
    order = shuffled_views(views, torch.Generator().manual_seed(3))
    seen = [next(order).index for _ in range(15)]
    for start in (0, 5, 10):
        assert sorted(seen[start : start + 5]) == [0, 1, 2, 3, 4]


def test_reduction_averages_areas_and_keeps_the_camera() -> None:
    camera = arc_rig()["cam01"]
    image = torch.zeros(32, 48, 3, dtype=torch.uint8)
    image[::2] = 200
    small = reduced(View(1, camera, image), 0.5)
    assert small.image.shape == (16, 24, 3)
    assert (small.image == 100).all()
    assert torch.allclose(small.camera.K[:2], camera.K[:2] * 0.5)
