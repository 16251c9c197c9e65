# SPDX-License-Identifier: Apache-2.0
"""The mean of a fit's last iterations."""

import torch
from hypothesis import given
from hypothesis import strategies as st

from structgstream.scene.state import ParameterName
from structgstream.training.optim import MeanOfSteps

Leaves = dict[ParameterName, torch.Tensor]


def leaf(*rows: float) -> torch.Tensor:
    return torch.tensor(rows)[:, None].requires_grad_()


@given(st.integers(0, 6), st.lists(st.floats(-4.0, 4.0, width=32), min_size=7, max_size=12))
def test_it_is_the_mean_of_the_iterations_after_the_first_ones(after: int, path: list[float]) -> None:
    mean = MeanOfSteps(after)
    values: Leaves = {"anchor_positions": leaf(0.0)}
    for iteration, value in enumerate(path, start=1):
        values["anchor_positions"].data.fill_(value)
        mean.add(iteration, values)
    address = values["anchor_positions"].data_ptr()
    mean.apply(values)
    expected = sum(path[after:]) / len(path[after:])
    assert abs(values["anchor_positions"].item() - expected) < 1e-5
    assert values["anchor_positions"].data_ptr() == address  # In place: the hooks share the leaves.


def test_rows_that_come_and_go_start_again_and_what_is_not_trained_stays() -> None:
    mean, fixed = MeanOfSteps(0), torch.tensor([[5.0]])
    mean.add(1, {"free_means": leaf(100.0, 200.0), "free_colors": fixed})
    mean.add(2, {"free_means": leaf(1.0, 2.0, 3.0), "free_colors": fixed})
    values: Leaves = {"free_means": leaf(3.0, 4.0, 5.0), "free_colors": fixed}
    mean.add(3, values)
    mean.apply(values)
    assert values["free_means"].flatten().tolist() == [2.0, 3.0, 4.0]
    assert torch.equal(values["free_colors"], torch.tensor([[5.0]]))


def test_without_iterations_nothing_changes() -> None:
    mean = MeanOfSteps(3)
    values: Leaves = {"anchor_positions": leaf(1.0)}
    mean.add(3, values)
    mean.apply(values)
    assert values["anchor_positions"].item() == 1.0
