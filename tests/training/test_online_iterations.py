# SPDX-License-Identifier: Apache-2.0
"""What happens around each iteration of a later frame."""

from dataclasses import fields, is_dataclass
from types import SimpleNamespace
from typing import Any, cast

import torch

from structgstream.kernels.values import TileSelection, tile_grid
from structgstream.scene.active_tiles import ActiveTiles
from structgstream.scene.scene import Scene
from structgstream.training.losses import GradientStatistics, SceneLoss
from structgstream.training.online.config import OnlineConfig, PatchingConfig
from structgstream.training.online.iterations import OnlineHooks, StartingPoint
from structgstream.training.online.measure import slot_count
from structgstream.training.online.patching import FreeSet
from structgstream.training.online.split import DynamicSplit
from structgstream.training.optim import Adam, LastPass
from structgstream.training.parameters import Parameters, parameters_of_fields
from structgstream.training.result import Stopwatch
from tests.support.backends import quickest_backend
from tests.support.rigs import random_scene
from tests.support.worlds import moving_world

CPU = torch.device("cpu")
BACKEND = quickest_backend()
WORLD = moving_world(1)
VIEWS = WORLD.views()
CAMERA = VIEWS[0].camera
WITH_FREE = random_scene(60, free=5, cameras=4, seed=4)


def hooks_of(start: StartingPoint, *, patch_at: int = 4, patches: bool = True, rest_every: int = 1) -> OnlineHooks:
    scene = start.scene
    parameters = Parameters.of(scene, trained=parameters_of_fields({"anchor_positions", "free"}))
    free_set = FreeSet(
        config=PatchingConfig(),
        template=scene,
        parameters=parameters,
        adam=Adam(BACKEND, parameters.values),
        statistics=GradientStatistics(slot_count(scene), CPU),
        views=start.views,
        frame_index=1,
        room=100,
        backend=BACKEND,
        generator=torch.Generator().manual_seed(0),
    )
    return OnlineHooks(
        start=start,
        parameters=parameters,
        config=OnlineConfig(),
        rate_term=None,
        smoothness=None,
        free_set=free_set,
        patch_at=patch_at,
        patches=patches,
        last_pass=LastPass(),
        backend=BACKEND,
        watch=Stopwatch(),
        rest_every=rest_every,
    )


def started(scene: Scene = WORLD.scene, **options: Any) -> StartingPoint:
    return StartingPoint(scene, VIEWS, torch.zeros(len(scene.anchors) + len(scene.free), 3), **options)


def selection(tiles: int) -> TileSelection:
    """The first ``tiles`` tiles of a picture."""
    mask = torch.zeros(tile_grid(CAMERA.width, CAMERA.height), dtype=torch.bool)
    mask.view(-1)[:tiles] = True
    return TileSelection(mask, CAMERA.width, CAMERA.height)


def focused(changed: TileSelection) -> StartingPoint:
    """A start of which the first two views show what moves, in three tiles."""
    still = WORLD.scene.gaussians(CAMERA, BACKEND).select(torch.zeros(0, dtype=torch.int64))
    active_tiles = {
        view.index: ActiveTiles(selection(3), torch.zeros(CAMERA.height, CAMERA.width, 3), still, changed)
        for view in VIEWS[:2]
    }
    return started(active_tiles=active_tiles)


def iterate(hooks: OnlineHooks, iteration: int, view: int = 0) -> SceneLoss:
    """The loss of an iteration that moves nothing, and what follows it."""
    loss = hooks.loss(iteration, VIEWS[view])
    hooks.after_step(iteration, VIEWS[view], loss.detached(), None)
    return loss


def pixels_drawn(hooks: OnlineHooks, *, view: int, visits: int) -> list[int]:
    """The number of pixels that each visit of a view in the active draws."""
    assert hooks.start.active_tiles is not None
    active, found = hooks.start.active_tiles[VIEWS[view].index], []
    for iteration in range(1, visits + 1):
        loss = iterate(hooks, iteration, view)
        assert loss.active is active  # Tiles that are not drawn hold their last drawing.
        found.append(int((active.picture.sum(2) > 0).sum()))
        active.picture.zero_()
    return found


def tensors(value: Any) -> list[torch.Tensor]:
    """All tensors in a loss."""
    if isinstance(value, torch.Tensor):
        return [value]
    if isinstance(value, dict):
        return [tensor for part in value.values() for tensor in tensors(part)]
    return [tensor for f in fields(value) for tensor in tensors(getattr(value, f.name))] if is_dataclass(value) else []


def test_nothing_of_a_loss_keeps_its_graph_once_the_step_is_taken() -> None:
    """What would be kept alive binds the next recording to another stream of the GPU."""
    loss = hooks_of(started(WITH_FREE)).loss(1, VIEWS[0])
    assert sum(tensor.requires_grad for tensor in tensors(loss)) > 9
    assert not any(tensor.requires_grad for tensor in tensors(loss.detached()))
    assert len(tensors(loss.detached())) > 15


def test_tiles_without_change_are_drawn_in_one_visit_of_three() -> None:
    hooks = hooks_of(focused(selection(1)), rest_every=3)
    drawn = pixels_drawn(hooks, view=0, visits=6)
    assert drawn[0] == drawn[1] == drawn[3] == drawn[4] > 0
    assert drawn[2] == drawn[5] > drawn[0]
    pixels_drawn(hooks, view=1, visits=1)  # Visits are counted by view.
    assert hooks.visits == {VIEWS[0].index: 6, VIEWS[1].index: 1}


def test_all_tiles_are_drawn_where_all_changed_or_no_visit_rests() -> None:
    whole = pixels_drawn(hooks_of(focused(selection(3)), rest_every=3), view=0, visits=4)
    assert len(set(whole)) == 1
    assert pixels_drawn(hooks_of(focused(selection(1)), rest_every=1), view=0, visits=4) == whole


def test_a_frame_is_patched_once_at_its_iteration() -> None:
    hooks = hooks_of(started(WITH_FREE), patch_at=3)
    hooks.parameters.values["free_logit_opacities"].data[2] = -9.0
    for iteration in (1, 2, 3, 4):
        iterate(hooks, iteration)
        assert hooks.free_set.pruned == (iteration >= 3)


def test_a_frame_whose_free_gaussians_stay_is_not_patched() -> None:
    hooks = hooks_of(started(WITH_FREE), patch_at=1, patches=False)
    hooks.parameters.values["free_logit_opacities"].data[2] = -9.0
    iterate(hooks, 1)
    assert hooks.free_set.pruned == 0
    assert len(hooks.free_set) == 5


def test_counts_are_those_of_the_moving_anchors_and_of_all_free_gaussians() -> None:
    assert hooks_of(started(WITH_FREE)).counts() == (60, 5)
    parted = SimpleNamespace(anchors=torch.arange(60) < 20, free=torch.arange(5) < 2)
    split = DynamicSplit.of(WITH_FREE, cast(Any, parted))
    start = StartingPoint(split.dynamic, VIEWS, torch.zeros(22, 3), split)
    assert hooks_of(start).counts() == (20, 5)


def test_each_frame_ends_with_the_psnr_of_its_last_pictures() -> None:
    hooks = hooks_of(started())
    loss = iterate(hooks, 1)
    assert hooks.last_pass.psnr > 30.0  # The pictures are the scene's own.
    with torch.no_grad():
        hooks.parameters.values["anchor_positions"] += 0.1
    worse = iterate(hooks, 2)
    assert worse.total > loss.total
    assert hooks.last_pass.psnr < 30.0
