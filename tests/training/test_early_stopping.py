# SPDX-License-Identifier: Apache-2.0
"""When a frame has settled."""

import pytest
import torch

from structgstream.training.early_stopping import EarlyStopping


def looked_at(early_stopping: EarlyStopping, losses: list[float], *, views: int) -> list[bool]:
    """Passes over the views, all with the loss of their pass; whether it had settled after each look."""
    found = []
    for loss in losses:
        for view in range(views):
            early_stopping.add(view, torch.tensor(loss))
            found.append(early_stopping.should_stop)
    return found


def test_it_settles_when_a_view_gains_little() -> None:
    found = looked_at(EarlyStopping(0.05, 6), [1.0, 0.8, 0.7, 0.69], views=6)
    assert not any(found[:18])  # 20 and 12 %.
    assert any(found[18:])  # 1.4 %.


def test_one_look_tells_nothing_and_zero_never_settles() -> None:
    assert not any(looked_at(EarlyStopping(0.5, 4), [1.0], views=4))
    assert not any(looked_at(EarlyStopping(0.0, 4), [1.0, 1.0, 2.0], views=4))


def test_views_are_compared_with_themselves() -> None:
    """Views differ from each other by far more than they gain."""
    early_stopping = EarlyStopping(0.05, 2)
    for loss in (1.0, 0.8, 0.64):
        early_stopping.add(0, torch.tensor(loss))
        early_stopping.add(1, torch.tensor(100.0 * loss))
        assert not early_stopping.should_stop


@pytest.mark.parametrize("again", [False, True])
def test_what_came_before_is_forgotten(again: bool) -> None:
    early_stopping = EarlyStopping(0.05, 6)
    assert any(looked_at(early_stopping, [1.0, 1.0], views=6))
    if again:
        early_stopping.reset()
    assert early_stopping.should_stop != again


def test_losses_may_come_in_one_tensor_that_is_written_again() -> None:
    loss, early_stopping = torch.tensor(1.0), EarlyStopping(0.05, 2)
    for value in (1.0, 0.5, 0.25):
        early_stopping.add(0, loss.fill_(value))
        assert not early_stopping.should_stop
