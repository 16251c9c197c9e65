# SPDX-License-Identifier: Apache-2.0
"""What moves, in a world where a known part of the anchors does."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from structgstream.errors import ConfigError
from structgstream.scene.free import FreeGaussians
from structgstream.scene.scene import Scene
from structgstream.training.online.config import MotionConfig
from structgstream.training.online.select import changed_primitives
from structgstream.training.online.split import DynamicSplit
from structgstream.training.residuals import BaselineResidual
from structgstream.training.views import training_views
from tests.support.backends import quickest_backend
from tests.support.rigs import random_scene
from tests.support.varied import varied
from tests.support.worlds import moved_since, moving_world

CPU = torch.device("cpu")
CONFIG = varied(MotionConfig(enabled=True, picture_scale=1.0), REACH_PIXELS=1)
WORLD = moving_world(2, speed=0.06, movers=20)


def moving(before: int = 0, now: int = 1, *, config: MotionConfig = CONFIG):
    views, earlier = (WORLD.views(t) for t in (now, before))
    return moved_since(WORLD.scene, views, earlier, config=config)


def test_the_anchors_that_moved_are_found_and_few_others() -> None:
    found = moving().anchors
    movers, others = found[:20].float().mean(), found[20:].float().mean()
    assert movers > 0.7  # The rest is hidden, too faint, or covers fewer pixels than MIN_CHANGED_PIXELS.
    assert others < movers - 0.2  # Those that the movers cover or uncover: pictures this small are crowded.


def test_anchors_that_no_two_views_show_go_with_their_neighbours() -> None:
    alone, carried = (moving(config=replace(CONFIG, occluded_share=share)) for share in (0.0, 0.5))
    assert alone.occluded_count == 0
    assert torch.equal(carried.anchors & alone.anchors, alone.anchors)
    assert carried.occluded_count == int((carried.anchors & ~alone.anchors).sum()) > 0


@pytest.mark.parametrize("share", [-0.1, 1.1])
def test_a_share_beyond_one_is_refused(share: float) -> None:
    with pytest.raises(ConfigError, match="occluded_share"):
        MotionConfig(occluded_share=share)


def test_nothing_moves_between_equal_pictures() -> None:
    found = moving(1, 1)
    assert not found.anchors.any()
    assert not found.free.any()


def test_one_view_is_not_enough() -> None:
    config = varied(CONFIG, MIN_VOTES=len(WORLD.rig.training) + 1)
    assert not moving(config=config).anchors.any()
    assert moving(config=varied(CONFIG, MIN_VOTES=1)).anchors.sum() >= moving().anchors.sum()


def test_each_view_tells_which_gaussians_it_shows() -> None:
    backend, found = quickest_backend(), moving()
    views = WORLD.views(1)
    assert found.visible.keys() == {view.index for view in views}
    for view in views:
        drawn = torch.zeros(60 * 5, dtype=torch.bool)
        drawn[WORLD.scene.gaussians(view.camera, backend).ids] = True
        visible = found.visible[view.index]
        assert 0 < visible.sum() < drawn.sum()  # Some are hidden behind others.
        assert not visible[~drawn].any()


def test_what_moved_before_moves_more_easily() -> None:
    strict = varied(replace(CONFIG, hysteresis=0.2), MIN_CHANGED_SHARE=0.9)
    views, earlier = (WORLD.views(t) for t in (1, 0))

    def found(before_previous: Scene | None) -> torch.Tensor:
        return moved_since(WORLD.scene, views, earlier, config=strict, before_previous=before_previous).anchors

    shift = torch.zeros_like(WORLD.scene.anchors.positions)
    shift[:20] = 0.01
    anchors = replace(WORLD.scene.anchors, positions=WORLD.scene.anchors.positions - shift)
    moved, first = found(replace(WORLD.scene, anchors=anchors)), found(None)
    assert torch.equal(found(WORLD.scene), first), "nothing moved before"
    assert moved[:20].sum() > first[:20].sum()
    assert torch.equal(moved[20:], first[20:])


def test_what_changed_is_reported_by_row_and_by_birth() -> None:
    earlier = random_scene(6, free=4)
    births = torch.tensor([1, 4, 6, 9])
    earlier = replace(earlier, free=replace(earlier.free, births=births))
    assert not changed_primitives(earlier, earlier).any()
    scales = earlier.anchors.log_base_scales.clone()
    scales[3, 2] += 0.1
    # One died, one is new, one has another colour.
    free = earlier.free.select(torch.tensor([0, 2, 3]))
    colors = free.colors.clone()
    colors[2] += 0.1
    free = replace(free, colors=colors).append(replace(free.select(torch.tensor([0])), births=torch.tensor([12])))
    scene = replace(earlier, anchors=replace(earlier.anchors, log_base_scales=scales), free=free)
    assert changed_primitives(earlier, scene).nonzero()[:, 0].tolist() == [3, 6 + 2, 6 + 3]


def test_free_gaussians_that_no_view_shows_stay() -> None:
    """A camera that is absent now may be the only one that sees them."""
    places = torch.tensor([[0.0, 0.0, -0.8], [0.0, 0.0, -50.0]])  # The second is behind all cameras.
    look = torch.full((2, 3), 0.1).log(), torch.full((2, 3), 0.5)
    free = FreeGaussians.spawned(places, *look, opacity=0.9, first_identity=1)
    scene = replace(WORLD.scene, free=free)
    views = WORLD.views()
    part = DynamicSplit.of(scene, moved_since(scene, views, views, config=CONFIG))
    assert part.merge(part.dynamic).free.births.tolist() == [1, 2]


def test_a_camera_that_was_absent_before_does_not_vote_and_is_seen() -> None:
    """The result is that of the others; but what it shows counts as visible, so that it is trained on."""
    views, before = (WORLD.views(t) for t in (1, 0))
    back = views[1]
    others, known = ([view for view in of if view.index != back.index] for of in (views, before))
    baseline = BaselineResidual(1.0, {view.index: torch.zeros(32, 48) for view in views})
    config = replace(CONFIG, residual_threshold=0.1)
    for given in (None, baseline):
        found, alone = (moved_since(WORLD.scene, of, known, config=config, baseline=given) for of in (views, others))
        assert torch.equal(found.anchors, alone.anchors)
        assert found.anchors.any()
        assert found.inliers == (0, 1, 2, 3)
        assert found.visible[back.index].any()


def test_a_camera_without_a_baseline_votes_by_its_pictures_alone() -> None:
    """It was absent from frame 0, and its residuals, being of unknown origin, would make everything move."""
    views, before = (WORLD.views(t) for t in (1, 0))
    dark = [
        [replace(view, image=view.image // 2) if view.index == 2 else view for view in of] for of in (views, before)
    ]
    known = {view.index: torch.ones(32, 48) for view in views if view.index != 2}
    config = replace(CONFIG, residual_threshold=0.05)
    found = moved_since(WORLD.scene, *dark, config=config, baseline=BaselineResidual(1.0, known))
    plain = moved_since(WORLD.scene, *dark, config=CONFIG)
    assert torch.equal(found.anchors, plain.anchors)


def test_what_a_mask_hides_gets_no_vote_from_its_view() -> None:
    hidden = {name: np.zeros((32, 48), bool) for name in WORLD.rig.training}
    for mask in hidden.values():
        mask[:, :3] = True  # a camera that shows something still is present
    for count, expected in ((2, True), (3, False)):
        masks = {name: hidden[name] for name in WORLD.rig.training[:count]}
        views, before = (training_views(replace(WORLD.frames[t], masks=masks), WORLD.rig, CPU) for t in (1, 0))
        found = moved_since(WORLD.scene, views, before, config=CONFIG)
        assert bool(found.anchors[:20].any()) == expected  # two of the four see it, then one
