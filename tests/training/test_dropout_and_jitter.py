# SPDX-License-Identifier: Apache-2.0
"""Dropout and jitter of Gaussians in frame 0."""

import pytest
import torch

from structgstream.gaussians import Gaussians
from structgstream.training.frame0.regularizers import PerturbationConfig, RandomNumbers, perturbation_at, perturbed
from tests.support.varied import varied

COUNT = 20_000


def gaussians() -> Gaussians:
    return Gaussians(
        means=torch.ones(COUNT, 3),
        quats=torch.ones(COUNT, 4),
        scales=torch.full((COUNT, 3), 0.5).requires_grad_(),
        opacities=torch.full((COUNT,), 0.3).requires_grad_(),
        colors=torch.ones(COUNT, 3),
        ids=torch.arange(COUNT),
    )


def numbers(seed: int = 0, *, length: int = 1 << 18) -> RandomNumbers:
    return RandomNumbers(torch.Generator().manual_seed(seed), torch.device("cpu"), length=length)


def test_random_numbers_differ_from_reading_to_reading() -> None:
    drawn = numbers()
    first, second = drawn.normal(COUNT), drawn.normal(COUNT)
    assert first.shape == (COUNT, 3)
    assert abs(torch.corrcoef(torch.stack([first.flatten(), second.flatten()]))[0, 1]) < 0.02
    shares = drawn.uniform(COUNT)
    assert 0.0 <= shares.min() < 0.01
    assert 0.99 < shares.max() < 1.0
    assert shares.mean().item() == pytest.approx(0.5, abs=0.01)


def test_more_random_numbers_than_a_table_holds() -> None:
    drawn = numbers(length=10)
    assert drawn.uniform(4).shape == (4,)
    many = drawn.normal(COUNT)
    assert many.unique().numel() > 2.9 * COUNT
    assert many.std().item() == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize("strength", [1.0, 0.5])
def test_a_share_is_left_out_and_the_mean_stays(strength: float) -> None:
    found = perturbed(gaussians(), PerturbationConfig(dropped_share=0.4), numbers(), strength=strength)
    gone = found.opacities == 0
    assert gone.float().mean().item() == pytest.approx(0.4 * strength, abs=0.01)
    assert found.opacities.mean().item() == pytest.approx(0.3, abs=0.01)
    assert torch.equal(found.means, gaussians().means)
    (gradient,) = torch.autograd.grad(found.opacities.sum(), [found.opacities])
    assert gradient.sum() == COUNT


def test_opacities_stay_below_one() -> None:
    found = perturbed(gaussians(), PerturbationConfig(dropped_share=0.9), numbers(), strength=1.0)
    assert found.opacities.max() < 1.0


@pytest.mark.parametrize("strength", [1.0, 0.5])
def test_means_are_shifted_by_their_extent(strength: float) -> None:
    found = perturbed(gaussians(), PerturbationConfig(noise_scales=0.2), numbers(), strength=strength)
    shift = found.means - 1.0
    assert shift.mean().item() == pytest.approx(0.0, abs=0.01)
    assert shift.std().item() == pytest.approx(0.2 * strength * 0.5, rel=0.05)
    assert torch.equal(found.opacities, gaussians().opacities)
    assert not shift.requires_grad, "noise is no reason to shrink"


def test_the_seed_decides() -> None:
    config = PerturbationConfig(dropped_share=0.2, noise_scales=0.2)
    one, same, other = (perturbed(gaussians(), config, numbers(seed), strength=1.0) for seed in (1, 1, 2))
    assert torch.equal(one.means, same.means)
    assert torch.equal(one.opacities, same.opacities)
    assert not torch.equal(one.means, other.means)


def test_it_fades_and_ends() -> None:
    config = varied(PerturbationConfig(dropped_share=0.4), UNTIL_SHARE=0.5)
    shares = []
    for iteration in (1, 25, 49):
        found = perturbation_at(iteration, 100, config, numbers())
        assert found is not None
        shares.append((found(gaussians()).opacities == 0).float().mean().item())
    assert shares == pytest.approx([0.4 * 0.98, 0.4 * 0.5, 0.4 * 0.02], abs=0.01)
    assert perturbation_at(50, 100, config, numbers()) is None
    assert perturbation_at(1, 100, PerturbationConfig(), numbers()) is None
