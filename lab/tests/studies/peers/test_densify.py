# SPDX-License-Identifier: Apache-2.0
"""What 3DGS clones, splits and drops, on Gaussians whose fate is known."""

import math
from dataclasses import replace

import pytest
import torch

from structgstream_studies.peers.densify import DensifyConfig, candidates, densify, reset_opacities
from structgstream_studies.peers.plain import PlainGaussians

CONFIG = DensifyConfig()


def rows(scales: list[float], opacities: list[float]) -> PlainGaussians:
    count = len(scales)
    quats = torch.zeros(count, 4)
    quats[:, 0] = 1
    return PlainGaussians(
        means=torch.arange(count)[:, None].expand(count, 3).float().contiguous(),
        log_scales=torch.tensor(scales).log()[:, None].expand(count, 3).contiguous(),
        quats=quats,
        logit_opacities=torch.logit(torch.tensor(opacities)),
        base_colors=torch.zeros(count, 3),
        sh=torch.zeros(count, 3, 3),
    )


def run(gaussians: PlainGaussians, gradient: list[float], *, prune_large: bool = False, config: DensifyConfig = CONFIG):
    generator = torch.Generator().manual_seed(0)
    return densify(
        gaussians, torch.tensor(gradient), config=config, extent=1.0, prune_large=prune_large, generator=generator
    )


def test_small_ones_are_cloned_and_large_ones_split() -> None:
    change = run(rows([0.005, 0.05, 0.005, 0.05], [0.5] * 4), [1e-3, 1e-3, 1e-5, 1e-5])
    assert change.keep.tolist() == [True, False, True, True]
    assert len(change.added) == 3
    torch.testing.assert_close(change.added.log_scales[0].exp(), torch.full((3,), 0.005))
    torch.testing.assert_close(change.added.log_scales[1:].exp(), torch.full((2, 3), 0.05 / 1.6))
    assert (change.added.means[1:] - 1.0).abs().max() < 0.25
    assert (change.added.means[1] != change.added.means[2]).any()
    assert change.removed == 0


def test_what_is_hardly_seen_goes() -> None:
    change = run(rows([0.01, 0.01], [0.5, 0.004]), [0.0, 0.0])
    assert change.keep.tolist() == [True, False]
    assert change.removed == 1


@pytest.mark.parametrize("prune_large", [False, True])
def test_what_is_too_large_goes_once_opacities_were_reset(prune_large: bool) -> None:
    change = run(rows([0.2, 0.05], [0.5, 0.5]), [0.0, 0.0], prune_large=prune_large)
    assert change.keep.tolist() == [not prune_large, True]


def test_room_goes_to_the_largest_gradients() -> None:
    gradient = torch.tensor([3e-4, 9e-4, 5e-4, 1e-5])
    assert candidates(gradient, threshold=2e-4, room=2).tolist() == [False, True, True, False]
    assert candidates(gradient, threshold=2e-4, room=0).tolist() == [False] * 4
    change = run(rows([0.005] * 4, [0.5] * 4), gradient.tolist(), config=replace(CONFIG, max_gaussians=5))
    assert len(change.added) == 1


def test_a_reset_lowers_and_never_raises() -> None:
    found = reset_opacities(torch.tensor([2.0, -10.0]))
    torch.testing.assert_close(found.sigmoid(), torch.tensor([0.01, 1 / (1 + math.exp(10))]))


def test_rounds_come_when_they_are_due() -> None:
    assert [i for i in range(1, 1001) if DensifyConfig(start=500, stop=900).is_due(i)] == [600, 700, 800, 900]
    reset = replace(CONFIG, reset_at=2000)
    assert not reset.has_reset(2000)
    assert reset.has_reset(2001)
    assert not CONFIG.has_reset(10**6)
