# SPDX-License-Identifier: Apache-2.0
"""Error shares, missing pixels, and how points of many rays become Gaussians."""

from dataclasses import replace

import pytest
import torch

from structgstream.cameras import Camera
from structgstream.kernels.backend import reference_backend
from structgstream.scene.color import CameraColor
from structgstream.scene.render import draw
from structgstream.training.online.config import SpawnRules
from structgstream.training.online.spawn import Spawned, _merge_points, outlier_mask, spawn_by_sweep
from structgstream.training.online.view_residuals import ViewResidual, view_residuals
from structgstream.training.residuals import BaselineResidual
from structgstream.training.views import View
from tests.support.worlds import moving_world

RULES = SpawnRules()
WORLD = moving_world(1, width=96, height=64)
VIEWS = WORLD.views()


def test_an_outlier_takes_two_views_and_half_of_those_that_see() -> None:
    coverage = torch.tensor([[10.0, 10, 10, 10], [10, 10, 10, 0.1], [10, 10, 10, 0.1], [10, 0, 10, 0.1]])
    wrong = torch.tensor([[6.0, 6, 6, 6], [6, 0, 6, 0.1], [0, 0, 6, 0.1], [0, 0, 0, 0.1]])
    found = outlier_mask(coverage, wrong, rules=RULES)
    # Two of four; one of three; three of four; one, since the others do not see it.
    assert found.tolist() == [True, False, True, False]
    assert not outlier_mask(coverage, 0.5 * coverage, rules=RULES).any(), "half is not more than half"


def spoiled(view: View) -> torch.Tensor:
    """A rendering that is right but for a square of 12 x 12 pixels."""
    picture = view.colors.clone()
    picture[20:32, 30:42] = 1.0 - picture[20:32, 30:42]
    return picture


def compared(
    picture: torch.Tensor, view: View, *, rules: SpawnRules, baseline: BaselineResidual | None
) -> ViewResidual:
    color = CameraColor.identity(view.index + 1)
    (found,) = view_residuals([picture], [view], color, baseline=baseline, rules=rules, backend=reference_backend())
    return found


def nothing_missing(view: View) -> ViewResidual:
    return ViewResidual(view, torch.zeros(64, 96, dtype=torch.bool), torch.zeros(64, 96))


def test_what_is_missing_is_what_differs_by_more_than_frame_0_did() -> None:
    view = VIEWS[1]
    none = compared(view.colors, view, baseline=None, rules=RULES)
    assert not none.wrong.any()
    assert not none.missing_share.any()
    found = compared(spoiled(view), view, baseline=None, rules=RULES)
    inner = (view.colors[20:32, 30:42] - 0.5).abs().mean(-1) > 0.2  # grey has no opposite
    assert found.wrong[20:32, 30:42][inner].all()
    assert not found.missing_share[:15].any()
    baseline = BaselineResidual(1.0, {view.index: torch.full((64, 96), 1.0)})
    assert not compared(spoiled(view), view, baseline=baseline, rules=RULES).missing_share.any()


@pytest.mark.parametrize(("camera", "size"), [(VIEWS[0].camera, (48, 32)), (VIEWS[0].camera.resized(64, 96), (32, 48))])
def test_pictures_are_compared_at_the_longer_side_that_is_asked_for(camera: Camera, size: tuple[int, int]) -> None:
    view = View(0, camera, torch.zeros(camera.height, camera.width, 3, dtype=torch.uint8))
    found = compared(view.colors, view, baseline=None, rules=replace(RULES, longer_side=48))
    assert (found.view.camera.width, found.view.camera.height) == size
    assert found.missing_share.shape == size[::-1]


def test_a_nearer_near_plane_has_as_many_depths_for_a_pixel_of_disparity() -> None:
    rules = SpawnRules()
    assert [rules.planes_of(near) for near in (0.24, 0.12, 0.1200001, 0.06, 0.03, 1e-4)] == [48, 48, 48, 96, 192, 384]


def test_without_anything_missing_nothing_is_spawned() -> None:
    views = [nothing_missing(view) for view in VIEWS]
    depths = {v.index: torch.full((64, 96), 5.0) for v in VIEWS}
    color = CameraColor.identity(len(VIEWS))
    found = spawn_by_sweep(views, depths, color, first_identity=7, rules=RULES, backend=reference_backend())
    assert (len(found.free), found.refused_count) == (0, 0)


def test_a_view_of_which_nothing_counts_neither_supports_nor_contradicts() -> None:
    """Four views miss a ball that frame 0 lacked; a fifth that is masked, or was absent from frame 0, misses nothing,
    and as an equal voice would prevent spawning."""
    world = moving_world(1, width=96, height=64, cameras=6, emerges_at=0)
    views = world.views()
    backend, color = reference_backend(), CameraColor.identity(len(views))
    without = {v.index: draw(world.scene.gaussians(v.camera, backend), v.camera, backend).image for v in views}
    depths = {v.index: torch.full((64, 96), torch.inf) for v in views}
    rules = replace(RULES, residual_threshold=0.05, max_contradictions=0.2, min_hits=1)
    baseline = BaselineResidual(1.0, {v.index: torch.zeros(64, 96) for v in views})

    def spawned(last: ViewResidual) -> int:
        found = [compared(without[v.index].clamp(0, 1), v, baseline=baseline, rules=rules) for v in views[:-1]]
        return len(spawn_by_sweep([*found, last], depths, color, first_identity=0, rules=rules, backend=backend).free)

    last = views[-1]
    silent = nothing_missing(last)
    masked = replace(last, mask=torch.zeros(64, 96, dtype=torch.bool), image=torch.zeros_like(last.image))
    unknown = replace(baseline, maps={index: m for index, m in baseline.maps.items() if index != last.index})
    absent = compared(without[last.index].clamp(0, 1), last, baseline=unknown, rules=rules)
    seen = compared(without[last.index].clamp(0, 1), masked, baseline=baseline, rules=rules)
    assert not absent.missing_share.any()
    assert not seen.missing_share.any()
    assert spawned(absent) == spawned(seen) > spawned(silent)


def merged(rules: SpawnRules) -> Spawned:
    """Of points in straight lines of 4, 8 and 3, a voxel apart in a line, lines far from each other."""
    points = torch.tensor([[float(x), 50.0 * row, 0.0] for row, n in enumerate((4, 8, 3)) for x in range(n)])
    values = torch.cat([points, torch.rand(15, 3), torch.ones(15, 1)], dim=1)
    return _merge_points(values, first_identity=7, rules=rules)


@pytest.mark.parametrize(
    ("overflow", "most", "rows", "refused"),
    [
        ("none", 9, [], 15),
        ("none", 15, [0, 1, 2], 0),
        ("small-clusters", 9, [0, 2], 8),
        ("small-clusters", 6, [2], 12),
        ("small-clusters", 2, [], 15),
        ("small-clusters", 15, [0, 1, 2], 0),
    ],
)
def test_where_there_are_too_many_whole_clusters_are_spawned_or_none(
    overflow: str, most: int, rows: list[int], refused: int
) -> None:
    found = merged(replace(RULES, overflow=overflow, most=most, min_hits=1))
    assert found.refused_count == refused
    assert sorted({round(float(y) / 50) for y in found.free.means[:, 1]}) == rows
    assert len(found.free) == sum((4, 8, 3)[row] for row in rows)
    assert found.free.births.tolist() == list(range(7, 7 + len(found.free)))


def test_where_there_are_too_many_spawned_gaussians_are_coarser() -> None:
    rules = replace(RULES, overflow="coarser", most=9, min_hits=1)
    found = merged(rules)
    assert (0 < len(found.free) <= 9, found.refused_count) == (True, 0)
    assert found.merged_count == 15 - len(found.free), "a cap that binds is reported"
    assert float(found.free.log_scales.mean()) > float(torch.tensor(RULES.size).log())
    unbound = replace(rules, most=15)
    assert merged(unbound).merged_count == 0
