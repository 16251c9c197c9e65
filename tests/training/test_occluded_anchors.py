# SPDX-License-Identifier: Apache-2.0
"""Motion is propagated to anchors that the dynamic ones occlude."""

import pytest
import torch

from structgstream.training.online.select import NEIGHBOURS, occluded_dynamic

GRID = torch.cartesian_prod(*(torch.arange(4.0),) * 3)
"""64 places of a body; another one of the same shape is 100 units away."""
POSITIONS = torch.cat([GRID, GRID + torch.tensor([100.0, 0.0, 0.0])])
INSIDE = (
    ((POSITIONS[:, 1:] > 0.5) & (POSITIONS[:, 1:] < 2.5)).all(1)
    & (POSITIONS[:, 0] % 100 > 0.5)
    & (POSITIONS[:, 0] % 100 < 2.5)
)
FIRST = torch.arange(128) < 64


def test_what_lies_within_a_body_goes_with_it() -> None:
    carried = occluded_dynamic(POSITIONS, FIRST & ~INSIDE, ~INSIDE, share=0.4)
    assert torch.equal(carried, FIRST & INSIDE)
    assert int(carried.sum()) == 8


def test_shown_anchors_decide_for_themselves() -> None:
    moving = FIRST & ~INSIDE
    moving[0] = False
    assert not occluded_dynamic(POSITIONS, moving, ~INSIDE, share=0.4)[0], "it is shown at rest beside what moves"


@pytest.mark.parametrize(("moved", "carried"), [(NEIGHBOURS // 2, True), (NEIGHBOURS // 2 - 1, False)])
def test_enough_of_the_neighbours_have_to_move(moved: int, carried: bool) -> None:
    around = torch.nn.functional.normalize(
        torch.randn(NEIGHBOURS, 3, generator=torch.Generator().manual_seed(1)), dim=1
    )
    positions = torch.cat([torch.zeros(1, 3), around])
    moving = torch.arange(NEIGHBOURS + 1).sub(1) < moved
    moving[0] = False
    shown = torch.arange(NEIGHBOURS + 1) > 0
    assert occluded_dynamic(positions, moving, shown, share=0.5).tolist() == [carried, *[False] * NEIGHBOURS]


def test_none_is_carried_where_nothing_moves_or_nothing_is_shown_or_the_share_is_zero() -> None:
    none = torch.zeros(128, dtype=torch.bool)
    assert not occluded_dynamic(POSITIONS, none, ~INSIDE, share=0.4).any()
    assert not occluded_dynamic(POSITIONS, none, none, share=0.4).any()
    assert not occluded_dynamic(POSITIONS, FIRST & ~INSIDE, ~INSIDE, share=0.0).any()
