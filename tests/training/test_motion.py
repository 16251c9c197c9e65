# SPDX-License-Identifier: Apache-2.0
"""What moves, in a world where a known part of the anchors does."""

from dataclasses import replace

import torch

from structgstream.kernels.backend import reference_backend
from structgstream.training.motion import MotionConfig, moving_parts
from structgstream.training.views import training_views
from worlds import moving_world

CPU = torch.device("cpu")
CONFIG = MotionConfig(enabled=True, reach_pixels=1, picture_scale=1.0)
WORLD = moving_world(2, speed=0.06, movers=20)


def moving(before: int = 0, now: int = 1, *, config: MotionConfig = CONFIG):
    views, earlier = (training_views(WORLD.frames[t], WORLD.rig, CPU) for t in (now, before))
    return moving_parts(WORLD.scene, views, earlier, config=config, backend=reference_backend())


def test_the_anchors_that_moved_are_found_and_few_others() -> None:
    found = moving().anchors
    movers, others = found[:20].float().mean(), found[20:].float().mean()
    assert movers > 0.7  # The rest is hidden, or too faint to be seen.
    assert others < movers - 0.2  # Those that the movers cover or uncover: pictures this small are crowded.


def test_nothing_moves_between_equal_pictures() -> None:
    found = moving(1, 1)
    assert not found.anchors.any()
    assert not found.free.any()


def test_one_view_is_not_enough() -> None:
    config = replace(CONFIG, least_views=len(WORLD.rig.training) + 1)
    assert not moving(config=config).anchors.any()
    assert moving(config=replace(CONFIG, least_views=1)).anchors.sum() >= moving().anchors.sum()


def test_each_view_tells_which_gaussians_it_shows() -> None:
    backend, found = reference_backend(), moving()
    views = training_views(WORLD.frames[1], WORLD.rig, CPU)
    assert found.shown.keys() == {view.index for view in views}
    for view in views:
        drawn = torch.zeros(60 * 5, dtype=torch.bool)
        drawn[WORLD.scene.gaussians(view.camera, backend).ids] = True
        shown = found.shown[view.index]
        assert 0 < shown.sum() < drawn.sum()  # Some are hidden behind others.
        assert not shown[~drawn].any()
