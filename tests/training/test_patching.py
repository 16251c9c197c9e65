# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace
from typing import Literal

import pytest
import torch

from structgstream.gaussians import Gaussians
from structgstream.geometry import quaternion_matrices
from structgstream.kernels.backend import reference_backend
from structgstream.training.online.config import PatchingConfig
from structgstream.training.online.patching import (
    IDS_PER_FRAME,
    choose_parents,
    gaussians_by_id,
    spawn_children,
    survivor_mask,
)
from structgstream.training.views import View
from tests.support.rigs import arc_rig, random_scene


def generator() -> torch.Generator:
    return torch.Generator().manual_seed(1)


def parents(count: int) -> Gaussians:
    g = generator()
    one = Gaussians(
        means=torch.tensor([[1.0, 2.0, 3.0]]),
        quats=torch.randn(1, 4, generator=g),
        scales=torch.tensor([[0.5, 0.1, 0.02]]),
        opacities=torch.tensor([0.9]),
        colors=torch.tensor([[0.1, 0.2, 0.3]]),
        ids=torch.tensor([0]),
    )
    return Gaussians(**{name: value.expand(count, *value.shape[1:]) for name, value in one.columns().items()})


def test_children_are_drawn_from_two_sigma() -> None:
    source = parents(200_000)
    config = PatchingConfig()
    means = spawn_children(
        source, source.means, first_identity=1 * IDS_PER_FRAME, config=config, generator=generator()
    ).means.double()
    rotation = quaternion_matrices(source.quats[:1].double())[0]
    sigma = rotation @ torch.diag(source.scales[0].double() ** 2) @ rotation.T
    assert torch.allclose(means.mean(0), source.means[0].double(), atol=5e-3)
    assert torch.allclose(torch.cov(means.T), 2.0 * sigma, atol=5e-3)


def test_uniform_children_are_anywhere_in_the_box_of_the_anchors() -> None:
    anchors = torch.tensor([[-1.0, 5.0, 0.0], [1.0, 0.0, 3.0], [0.0, 1.0, 2.0]])
    config = PatchingConfig(spawn="uniform")
    children = spawn_children(parents(100_000), anchors, first_identity=0, config=config, generator=generator())
    low, high = torch.tensor([-1.0, 0.0, 0.0]), torch.tensor([1.0, 5.0, 3.0])
    assert torch.allclose(children.means.mean(0), (low + high) / 2, atol=2e-2)
    assert torch.allclose(children.means.var(0), (high - low) ** 2 / 12, atol=2e-2)
    assert ((children.means >= low) & (children.means <= high)).all()


def test_a_childs_other_attributes() -> None:
    source = parents(3)
    children = spawn_children(
        source, source.means, first_identity=7 * IDS_PER_FRAME, config=PatchingConfig(), generator=generator()
    )
    assert torch.allclose(children.log_scales.exp(), source.scales)
    assert torch.equal(children.colors, source.colors)
    assert torch.equal(children.quats, torch.tensor([[1.0, 0, 0, 0]]).expand(3, 4))
    assert torch.allclose(children.logit_opacities.sigmoid(), torch.full((3,), 0.1))
    assert children.births.tolist() == [7 * IDS_PER_FRAME + n for n in range(3)]


def test_the_threshold_chooses_parents_structured_or_free() -> None:
    gradient = torch.tensor([0.0009, 0.0011, 0.5, 0.002])
    count = torch.tensor([3.0, 3.0, 0.0, 1.0])  # The third was never drawn.
    chosen = choose_parents(gradient, count, room=10, config=PatchingConfig(), generator=generator())
    assert chosen.tolist() == [1, 3]


def test_the_cap_prefers_large_gradients() -> None:
    gradient = torch.tensor([0.002, 0.004, 0.003])
    chosen = choose_parents(gradient, torch.ones(3), room=2, config=PatchingConfig(), generator=generator())
    assert chosen.tolist() == [1, 2]


@pytest.mark.parametrize("rule", ["random", "uniform"])
def test_random_spawning_takes_as_many_but_others(rule: Literal["random", "uniform"]) -> None:
    gradient = torch.zeros(1000)
    gradient[:50] = 1.0
    config = PatchingConfig(spawn=rule)
    chosen = choose_parents(gradient, torch.ones(1000), room=999, config=config, generator=generator())
    assert len(chosen) == 50
    assert (chosen >= 50).any()


def test_off_spawns_nothing() -> None:
    config = PatchingConfig(spawn="off")
    assert choose_parents(torch.ones(4), torch.ones(4), room=9, config=config, generator=generator()).numel() == 0


def test_pruning_by_opacity() -> None:
    free = replace(random_scene(free=3).free, logit_opacities=torch.logit(torch.tensor([0.004, 0.006, 0.5])))
    assert survivor_mask(free, PatchingConfig()).tolist() == [False, True, True]
    assert survivor_mask(free, PatchingConfig(prune_opacity=None)).all()


def test_parents_are_found_in_the_first_view_that_draws_them() -> None:
    scene, rig, backend = random_scene(free=5), arc_rig(), reference_backend()
    views = [View(i, rig[name], torch.zeros(32, 48, 3, dtype=torch.uint8)) for i, name in enumerate(rig.training)]
    first = scene.gaussians(views[0].camera, backend)
    ids = torch.cat([first.ids[::7], first.ids[-2:]]).unique()
    found = gaussians_by_id(scene, views, ids, backend)
    assert torch.equal(found.ids, ids)
    rows = torch.searchsorted(first.ids, ids)
    assert torch.equal(found.colors, first.colors[rows])
    assert len(gaussians_by_id(scene, views, ids[:0], backend)) == 0
