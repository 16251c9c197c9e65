# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import pytest
import torch

from structgstream.kernels.backend import reference_backend
from structgstream.scene.order import in_morton_order, morton_cells, morton_keys, morton_order
from structgstream.scene.render import draw
from structgstream.scene.state import state_of
from tests.support.rigs import arc_rig, random_scene


def test_a_cube_is_walked_through_octant_by_octant() -> None:
    corners = torch.tensor([[x, y, z] for x in (0.0, 1.0) for y in (0.0, 1.0) for z in (0.0, 1.0)])
    walked = corners[morton_order(corners)]
    assert walked.tolist() == [[float(n & 1), float(n >> 1 & 1), float(n >> 2 & 1)] for n in range(8)]


def test_order_does_not_depend_on_scale_place_or_the_order_before() -> None:
    g = torch.Generator().manual_seed(2)
    points = torch.randn(300, 3, generator=g)
    ordered = points[morton_order(points)]
    shuffled = points[torch.randperm(300, generator=g)]
    assert torch.equal(shuffled[morton_order(shuffled)], ordered)
    assert torch.equal((points * 8)[morton_order(points * 8)], ordered * 8)


def test_neighbours_in_memory_are_neighbours_in_space() -> None:
    points = torch.rand(2000, 3, generator=torch.Generator().manual_seed(1))

    def step(positions: torch.Tensor) -> float:
        return float((positions[1:] - positions[:-1]).norm(dim=1).mean())

    assert step(points[morton_order(points)]) < 0.2 * step(points)


def test_keys_and_cells() -> None:
    cells = torch.tensor([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [2, 0, 3], [2**20 - 1] * 3, [5, 2**19, 0]])
    keys = morton_keys(cells)
    assert keys.tolist() == [0, 1, 2, 4, 44, 2**60 - 1, 0b1000001 | 1 << 58]
    assert torch.equal(morton_cells(keys), cells)


def test_the_order_of_a_grid() -> None:
    g = torch.Generator().manual_seed(4)
    cells = torch.randint(-4, 6, (500, 3), generator=g)
    positions = cells * 0.37 + (torch.rand(500, 3, generator=g) - 0.5) * 0.3
    order = morton_order(positions, step=0.37)
    keys = morton_keys(cells - cells.min(0).values)
    assert (keys[order].diff() >= 0).all()
    same = keys[order].diff() == 0
    assert same.any()
    assert (order.diff()[same] > 0).all(), "ties stay as they were"
    assert torch.equal(morton_order(positions, step=1e-9), morton_order(positions)), "cells cannot be as small"


@pytest.mark.parametrize("points", [torch.zeros(0, 3), torch.ones(1, 3), torch.ones(5, 3), torch.full((3, 3), -1e30)])
def test_nothing_one_and_many_of_the_same(points: torch.Tensor) -> None:
    assert morton_order(points).tolist() == [*range(len(points))]
    assert morton_order(points, step=0.5).tolist() == [*range(len(points))]


def test_the_picture_stays() -> None:
    scene, rig, backend = random_scene(60, seed=5), arc_rig(4), reference_backend()
    ordered = in_morton_order(scene)
    assert not torch.equal(ordered.anchors.positions, scene.anchors.positions)
    for name in rig:
        one, other = (draw(s.gaussians(rig[name], backend), rig[name], backend).image for s in (scene, ordered))
        assert one.max() > 0.1
        torch.testing.assert_close(one, other, atol=1e-5, rtol=0)
    order = morton_order(scene.anchors.positions)
    for name in ("anchor_positions", "offset_scales", "base_scales", "anchor_offsets", "anchor_features"):
        assert torch.equal(state_of(ordered)[name], state_of(scene)[name][order])
    assert torch.equal(in_morton_order(ordered).anchors.features, ordered.anchors.features)


def test_free_gaussians_must_come_later() -> None:
    with pytest.raises(AssertionError, match="ids of free Gaussians"):
        in_morton_order(replace(random_scene(5), free=random_scene(1, free=2).free))
