# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import pytest
import torch

from structgstream.gaussians import Gaussians
from structgstream.kernels.values import StructuredGaussians
from structgstream.training.frame0.densify import GrowthConfig, OpacityStatistics, grow, prunable_mask
from tests.support.rigs import random_scene

VOXEL = 0.01


def slots(anchors) -> int:
    return len(anchors) * anchors.offsets_per_anchor


def grown(anchors, gradient: torch.Tensor | float = 1.0, *, count: float = 100.0, most: int = 10**6):
    """What grows where every Gaussian has this gradient, and was drawn so often."""
    return grow(
        anchors,
        mean_gradient=torch.as_tensor(gradient).expand(slots(anchors)),
        count=torch.full((slots(anchors),), count),
        voxel_size=VOXEL,
        config=GrowthConfig(),
        most=most,
        generator=torch.Generator().manual_seed(0),
    )


def test_nothing_grows_without_gradient_or_without_evidence() -> None:
    anchors = random_scene().anchors
    assert len(grown(anchors, 0.0)) == 0
    assert len(grown(anchors, count=40.0)) == 0  # 40 is not more than 40


def test_new_anchors_sit_on_cells_that_were_empty() -> None:
    anchors = random_scene(60).anchors
    new = grown(anchors)
    sizes = [16 * VOXEL, 4 * VOXEL, VOXEL]
    assert sorted(new.cell_sizes.unique().tolist(), reverse=True) == pytest.approx(sizes)
    for cell in sizes:
        mine = new.positions[(new.cell_sizes - cell).abs() < 1e-6]
        cells = (mine / cell).round()
        assert torch.allclose(cells * cell, mine, atol=1e-5)
        assert len(cells.unique(dim=0)) == len(cells)
        old = {tuple(row) for row in (anchors.positions / cell).round().int().tolist()}
        assert not any(tuple(row) in old for row in cells.int().tolist())


def test_finer_levels_wait_for_a_coarser_one() -> None:
    anchors = random_scene(60).anchors
    # One candidate at one place: the coarse cell around it is occupied by its own anchor, so nothing follows.
    tight = replace(anchors, offsets=anchors.offsets * 1e-6)
    assert len(grown(tight)) == 0


def test_features_are_the_largest_of_the_parents() -> None:
    anchors = random_scene(200).anchors
    new = grown(anchors)
    assert (new.features.amax(0) <= anchors.features.amax(0)).all()
    assert torch.isfinite(new.features).all()
    parents = anchors.features.repeat_interleave(anchors.offsets_per_anchor, 0)
    for row in new.features[:20]:
        assert all((parents[:, d] == row[d]).any() for d in range(row.shape[0]))


def test_a_new_anchor_has_the_features_of_the_one_whose_gaussians_ask_for_it() -> None:
    anchors = random_scene(60).anchors
    far = replace(anchors, offsets=10 * anchors.offsets)
    gradient = torch.zeros(len(anchors), anchors.offsets_per_anchor)
    gradient[5] = 1.0
    new = grown(far, gradient.flatten())
    assert len(new) > 0
    assert (new.features == anchors.features[5]).all()


def test_the_cap_holds() -> None:
    assert len(grown(random_scene(60).anchors, most=63)) == 3


def test_the_cap_keeps_the_strongest_wherever_they_lie() -> None:
    anchors = random_scene(60).anchors
    # The last anchors pull most, and no order of cells follows from it.
    gradient = torch.linspace(1.0, 3.0, slots(anchors))
    every, few = grown(anchors, gradient), grown(anchors, gradient, most=67)
    assert len(few) == 7 < len(every)
    assert few.strengths.min() >= every.strengths.sort(descending=True).values[6]
    rows = [int((every.positions == position).all(1).nonzero()[0, 0]) for position in few.positions]
    assert torch.equal(every.features[rows], few.features)
    assert len(grown(anchors, gradient, most=50)) == 0


def test_room_for_anchors_comes_little_by_little() -> None:
    config = GrowthConfig(start=100, room_until=500, max_anchors=5_000)
    assert [config.room_at(at, 1_000) for at in (50, 100, 200, 500, 900)] == [1_000, 1_000, 2_000, 5_000, 5_000]
    assert config.room_at(200, 9_000) == 5_000  # More seeds than there may be: none is added.
    assert GrowthConfig(max_anchors=5_000).room_at(0, 1_000) == 5_000
    assert replace(config, min_growth=0.25).room_at(500, 8_000) == 10_000
    assert replace(config, min_growth=0.25).room_at(300, 8_000) == 9_000
    assert replace(config, min_growth=0.25).room_at(500, 1_000) == 5_000


def test_transparent_anchors_go_once_they_were_seen_enough() -> None:
    statistics = OpacityStatistics(3, torch.device("cpu"))
    none = Gaussians(*(torch.zeros(0),) * 6)
    raw = torch.tensor([[0.001, -1.0], [0.4, -1.0], [0.001, 0.0]])
    for step in range(81):
        visible = torch.tensor([0, 1, 2]) if step else torch.tensor([0, 1])
        statistics.add(StructuredGaussians(none, visible, raw[: len(visible)]))
    # The last was seen 80 times only.
    assert prunable_mask(statistics, GrowthConfig()).tolist() == [True, False, False]
