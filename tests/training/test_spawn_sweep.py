# SPDX-License-Identifier: Apache-2.0
"""What a rendering lacks in each view, and the sweep for its depth in front of what is drawn."""

from dataclasses import replace
from typing import Any

import pytest
import torch

from structgstream.kernels.values import RasterOutput
from structgstream.training.online import spawn
from structgstream.training.online.config import MotionConfig, SpawnRules
from structgstream.training.online.spawn import Sweep, missing_share
from structgstream.training.online.split import DynamicSplit, find_active_tiles
from structgstream.training.residuals import baseline_residual
from tests.support.backends import quickest_backend
from tests.support.worlds import emerging_ball, moved_since, moving_world

WORLD = moving_world(2, cameras=6, emerges_at=1, movers=0, width=96, height=64)
RULES = SpawnRules(min_hits=2)


def sweep(rules: SpawnRules = RULES) -> Sweep:
    """Over the frame in which a ball emerges."""
    backend, motion = quickest_backend(), MotionConfig(enabled=True, picture_scale=1.0)
    first, views = (WORLD.views(t) for t in (0, 1))
    split = DynamicSplit.of(WORLD.scene, moved_since(WORLD.scene, views, first, config=motion, backend=backend))
    active_tiles = find_active_tiles(split, views, config=motion, backend=backend)
    baseline = baseline_residual(WORLD.scene, first, scale=1.0, backend=backend)
    return Sweep(split.dynamic, split.static, views, active_tiles, baseline, rules, backend)


def test_missing_is_the_ball_in_the_views_that_show_it() -> None:
    found, ball = sweep().missing(), emerging_ball(0.95)
    assert len(found) == len(WORLD.rig.training)
    showing = 0
    for entry in found:
        rows, columns = (entry.residual.missing_share > 0.5).nonzero().unbind(1)
        if not entry.any:
            assert not len(rows)
            continue
        showing += 1
        viewport = entry.view.camera.viewport(ball.means)
        local = viewport.viewmat[:3, :3] @ ball.means[0] + viewport.viewmat[:3, 3]
        center = (viewport.K @ local)[:2] / local[2]
        middle = torch.stack([columns.float().mean(), rows.float().mean()]) + 0.5
        assert (middle - center).norm() < 6.0, "pixels of 96"
    assert showing >= 3
    assert 0.0 < missing_share(found) < 0.1


def test_drawn_again_the_same_is_missing() -> None:
    swept = sweep()
    found = swept.missing()
    for before, after in zip(found, swept.drawn(found), strict=True):
        if before.any:
            assert torch.equal(before.residual.missing_share, after.residual.missing_share)


def test_what_another_sweep_has_drawn_is_not_drawn_again() -> None:
    swept, drawings = sweep(), []
    found = swept.missing()
    assert any(entry.drawn is not None for entry in found)

    def draw_views(*args: Any, **options: Any) -> list[RasterOutput]:
        drawings.append(options["tiles"])
        return swept.backend.draw_views(*args, **options)

    counted = replace(swept, backend=swept.backend.with_functions(draw_views=draw_views))
    for first, second in zip(found, counted.missing(known=found), strict=True):
        assert torch.equal(first.residual.missing_share, second.residual.missing_share)
    assert not drawings
    counted.missing()
    assert drawings, "without what is known"


def test_what_too_few_views_miss_is_not_spawned() -> None:
    swept = sweep(replace(RULES, min_supports=6))
    unsupported = swept.spawn(swept.missing(), first_identity=0, room=9)
    assert not len(unsupported.free), "six others of six"
    assert not unsupported.refused_count


def test_a_depth_map_is_infinite_where_nothing_is_drawn() -> None:
    swept = sweep()
    camera = swept.views[0].camera
    (depth,) = swept.depth_maps(swept.views[:1])
    assert depth.shape == (camera.height, camera.width)
    assert bool(depth.isinf().any())
    solid = depth[depth.isfinite()]
    assert len(solid)
    assert float(solid.min()) > camera.near


def test_what_is_found_lies_in_the_middle_of_a_pixel_of_its_view(monkeypatch: pytest.MonkeyPatch) -> None:
    """Before points of several views are merged."""
    swept, found, merge = sweep(), list[torch.Tensor](), spawn._merge_points

    def noted(values: torch.Tensor, **options: Any) -> Any:
        found.append(values[:, :3])
        return merge(values, **options)

    monkeypatch.setattr(spawn, "_merge_points", noted)
    swept.spawn(swept.missing(), first_identity=0, room=9)
    (points,) = found
    beside = []
    for view in swept.views:
        viewport = view.camera.viewport(points)
        seen = (points @ viewport.viewmat[:3, :3].T + viewport.viewmat[:3, 3]) @ viewport.K.T
        pixels = seen[:, :2] / seen[:, 2:]
        beside.append((pixels - pixels.floor() - 0.5).abs().amax(1))
    assert len(points) >= 3
    assert float(torch.stack(beside).amin(0).max()) < 1e-2
