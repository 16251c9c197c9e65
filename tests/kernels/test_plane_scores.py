# SPDX-License-Identifier: Apache-2.0
"""The oracle of correlation through planes, against plain sums."""

import pytest
import torch
from torch import Tensor

from structgstream.kernels.reference_motion import plane_scores

SAME = torch.eye(3, dtype=torch.float64)


def picture(seed: int) -> Tensor:
    return torch.rand(9, 11, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def scores(own: Tensor, others: list[Tensor], warps: list[Tensor], *, noise: float = 1e-3) -> Tensor:
    return plane_scores(own, others, torch.stack(warps)[None], window=3, noise=noise)[0]


def test_a_score_is_the_correlation_of_two_windows() -> None:
    own, other = picture(0), picture(1)
    found = scores(own, [other], [SAME])
    one, two = own[3:6, 5:8], other[3:6, 5:8]
    covariance = ((one - one.mean()) * (two - two.mean())).mean()
    expected = covariance / ((one.var(unbiased=False) + 1e-3) * (two.var(unbiased=False) + 1e-3)).sqrt()
    assert found[4, 6].item() == pytest.approx(expected.item(), abs=1e-12)


def test_a_warp_by_half_a_pixel_is_the_mean_of_two() -> None:
    own = picture(0)
    other = torch.zeros(9, 12, dtype=torch.float64)
    other[:, 1:] = own  # What is halfway between ``other[x]`` and ``other[x + 1]``, in ``own``'s pixels.
    shifted = SAME.clone()
    shifted[0, 2] = 0.5
    halves = (other[:, 1:] + other[:, :-1]) / 2
    found = scores(halves, [other], [shifted], noise=0.0)
    torch.testing.assert_close(found[:, :-1], torch.ones(9, 10, dtype=torch.float64))


def test_a_window_that_is_not_seen_whole_counts_half_of_the_best() -> None:
    own = picture(0)
    moved = SAME.clone()
    moved[0, 2] = 4.0  # Sees the first seven columns only, and whole windows of the first six.
    both = scores(own, [own, own, picture(1)], [SAME, moved, moved], noise=0.0)
    torch.testing.assert_close(both[:, 6:], torch.full((9, 5), 0.75, dtype=torch.float64))
    alone = scores(own, [own], [moved])
    assert (alone[:, 6:] == -0.5).all()
    assert (alone[:, :6] != -0.5).all()


def test_what_is_behind_the_neighbour_is_not_seen() -> None:
    own = picture(0)
    assert (scores(own, [own], [-SAME]) == -0.5).all()


def test_the_better_half_is_rounded_up() -> None:
    own = picture(0)
    one, two, three = (scores(own, [picture(n)], [SAME]) for n in (1, 2, 3))
    found = scores(own, [picture(n) for n in (1, 2, 3)], [SAME] * 3)
    best = torch.stack([one, two, three]).sort(0).values[1:].mean(0)
    torch.testing.assert_close(found, best)


def test_textureless_windows_correlate_with_none() -> None:
    flat = torch.full((9, 11), 0.4, dtype=torch.float64)
    assert scores(flat, [picture(1)], [SAME]).abs().max() < 1e-9
