# SPDX-License-Identifier: Apache-2.0
"""The scene of a frame as anchors, from which the next period's first frame is fitted."""

from dataclasses import replace

import torch

from structgstream.scene.appearance import with_appearance
from structgstream.training.frame0.seeding import warm_start
from tests.support.rigs import random_scene
from tests.support.streams import same

CELL = 0.1


def test_anchors_stay_and_free_gaussians_become_some() -> None:
    scene = random_scene(7, free=40)
    started = warm_start(scene, cell=CELL)
    anchors, before = started.anchors, len(scene.anchors)
    assert len(started.free) == 0
    assert torch.equal(anchors.positions[:before], scene.anchors.positions)
    new = anchors.positions[before:]
    assert 0 < len(new) <= 40
    taken = (scene.anchors.positions / CELL).round()
    cells = (scene.free.means / CELL).round()
    expected = {tuple(cell) for cell in cells.tolist()} - {tuple(cell) for cell in taken.tolist()}
    assert len(new) == len(expected)
    nearest = (new[:, None] - scene.free.means).norm(dim=2).amin(1)
    assert float(nearest.max()) < CELL


def test_new_anchors_are_as_large_as_their_gaussians_and_look_like_their_neighbours() -> None:
    scene = random_scene(7, free=1)
    free = replace(scene.free, means=torch.full((1, 3), 9.0), log_scales=torch.tensor([[-3.0, -2.0, -4.0]]))
    started = warm_start(replace(scene, free=free), cell=CELL)
    nearest = int((scene.anchors.positions - 9.0).norm(dim=1).argmin())
    assert torch.allclose(started.anchors.positions[-1], torch.full((3,), 9.0))
    size = torch.full((3,), 2.0 * float(torch.tensor(-2.0).exp()))
    assert torch.allclose(started.anchors.log_base_scales[-1].exp(), size)
    assert torch.equal(started.anchors.features[-1], scene.anchors.features[nearest])
    assert not started.anchors.offsets[-1].any()


def test_appearance_is_in_the_features_and_the_environment_is_left_to_the_fit() -> None:
    scene = with_appearance(random_scene(5), 2)
    anchors = replace(scene.anchors, appearance=torch.ones(5, 2))
    scene = replace(scene, anchors=anchors, environment=torch.zeros(4, 3))
    started = warm_start(scene, cell=CELL)
    assert torch.allclose(started.anchors.features, scene.features)
    assert started.anchors.appearance is None
    assert started.appearance_basis is None
    assert started.environment is None


def test_without_free_gaussians_it_is_the_scene() -> None:
    scene = random_scene(5)
    assert same(warm_start(scene, cell=CELL), scene)
