# SPDX-License-Identifier: Apache-2.0
"""Nearest neighbours in space."""

import torch

from structgstream.training.neighbours import nearest, nearest_others


def test_the_nearest_come_first() -> None:
    points, among = torch.tensor([[0.0, 0.0, 0.0]]), torch.tensor([[3.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 2.0]])
    rows, distances = nearest(points, among, 2)
    assert rows.tolist() == [[1, 2]]
    assert distances.tolist() == [[1.0, 2.0]]
    assert nearest(points, among, 1)[0].shape == (1, 1)
    assert nearest(points, among, 9)[0].tolist() == [[1, 2, 0]], "all, if more are asked for"


def test_nothing_is_its_own_neighbour() -> None:
    """Even where several points lie at one place."""
    points = torch.cat([torch.zeros(5, 3), torch.ones(2, 3)])
    for count in (1, 3, 6, 20):
        rows, distances = nearest_others(points, count)
        assert rows.shape == distances.shape == (7, min(count, 6))
        assert (rows != torch.arange(7)[:, None]).all()
        assert (distances[:, 1:] >= distances[:, :-1]).all()
