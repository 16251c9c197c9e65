# SPDX-License-Identifier: Apache-2.0
"""A scene in two parts gives the pictures and the gradients of the whole, where something moves."""

from collections.abc import Callable
from dataclasses import replace

import torch

from structgstream.kernels.backend import Backend
from structgstream.scene.free import FreeGaussians
from structgstream.scene.render import draw
from structgstream.scene.state import PAPER_DYNAMIC
from structgstream.training.losses import LossWeights, view_loss
from structgstream.training.online.config import MotionConfig
from structgstream.training.online.optimize import SHARED_FIELDS
from structgstream.training.online.select import DynamicSelection
from structgstream.training.online.split import DynamicSplit, changed_tiles, find_active_tiles
from structgstream.training.optim import gradients_of
from structgstream.training.parameters import Parameters, parameters_of_fields
from structgstream.training.result import Stopwatch
from tests.support.backends import on_each_backend
from tests.support.rigs import random_scene
from tests.support.streams import same
from tests.support.varied import varied
from tests.support.worlds import moving_world

WORLD = moving_world(2, width=96, height=64)
VIEWS = WORLD.views(1)
SCENE = random_scene(60, free=8, cameras=4, seed=4)


def some(scene=SCENE) -> DynamicSplit:
    """A few anchors and free Gaussians move; nothing is hidden."""
    anchors = torch.zeros(len(scene.anchors), dtype=torch.bool)
    anchors[[3, 17]] = True
    free = torch.arange(len(scene.free)) == 5
    slots = torch.ones(len(scene.anchors) * scene.anchors.offsets_per_anchor + len(scene.free), dtype=torch.bool)
    return DynamicSplit.of(scene, DynamicSelection(anchors, free, {view.index: slots for view in VIEWS}))


def test_the_parts_make_the_whole_again() -> None:
    split = some()
    assert len(split.dynamic.anchors) == 2
    assert len(split.dynamic.anchors) + len(split.static.anchors) == 60
    assert len(split.dynamic.free) + len(split.static.free) == 8
    assert same(split.merge(split.dynamic), SCENE)


def test_what_moved_moves_and_births_stay_in_order() -> None:
    split = some()
    moving = split.dynamic
    spawned = FreeGaussians(**{**vars(moving.free), "births": torch.tensor([77])})
    moved = replace(
        moving,
        anchors=replace(moving.anchors, positions=moving.anchors.positions + 1.0),
        free=moving.free.append(spawned),
    )
    whole = split.merge(moved)
    difference = (whole.anchors.positions - SCENE.anchors.positions).abs().sum(1)
    assert difference.nonzero()[:, 0].tolist() == [3, 17]
    assert whole.free.births.tolist() == [*range(8), 77]
    assert torch.equal(whole.free.means[8], moving.free.means[0])


@on_each_backend
def test_active_tiles_draw_and_learn_what_the_whole_picture_would(build: Callable[[], Backend]) -> None:
    """The gradient of a step with them is that of the same step over the whole picture: to float32 rounding."""
    backend = build()
    config = varied(MotionConfig(enabled=True), MARGIN_PIXELS=24)
    split = some()
    active_tiles = find_active_tiles(split, VIEWS, config=config, backend=backend)
    trained = parameters_of_fields(PAPER_DYNAMIC.difference(SHARED_FIELDS))
    assert active_tiles.keys() == {view.index for view in VIEWS}
    shares = []
    for view in VIEWS:
        active, camera = active_tiles[view.index], view.camera
        inside = active.tiles.pixels()
        shares.append(float(inside.float().mean()))
        whole = draw(SCENE.gaussians(camera, backend), camera, backend).image.detach()
        part = draw(split.dynamic.gaussians(camera, backend), camera, backend, active=active).image.detach()
        assert (part - whole)[inside].abs().max() < 1e-5
        found = []
        for scene, place in ((SCENE, None), (split.dynamic, active)):
            parameters = Parameters.of(scene, trained=trained)
            loss = view_loss(
                parameters.scene(scene),
                view,
                backend=backend,
                weights=LossWeights(volume=0.0),
                track_screen=False,
                watch=Stopwatch(),
                active=place,
            )
            found.append(gradients_of(loss, parameters.values, Stopwatch())[0])
        for name, theirs in found[1].items():
            rows = split.selection.free if name.startswith("free") else split.selection.anchors
            ours = found[0][name][rows]
            assert (ours - theirs).norm() <= 1e-4 * ours.norm(), name
    assert max(shares) < 0.9


def test_changed_tiles_are_those_that_hold_a_changed_pixel() -> None:
    """40 x 24 pixels are three by two tiles of 16, the last ones partial; the mask is at half the size."""
    tiles = torch.tensor([[[True, True, True], [True, True, False]]]).repeat(3, 1, 1)
    still, changed = torch.zeros(2, 12, 20, dtype=torch.bool)
    changed[3, 9] = changed[9, 1] = changed[10, 18] = True  # The last one lies in a tile that is not among them.
    found = changed_tiles(tiles, [None, still, changed], (24, 40))
    assert torch.equal(found[0], tiles[0])
    assert torch.equal(found[1], tiles[1])  # Nothing changed: all of them, since none would teach nothing.
    assert found[2].tolist() == [[False, True, False], [True, False, False]]
    assert torch.equal(changed_tiles(tiles, [None] * 3, (24, 40)), tiles)
