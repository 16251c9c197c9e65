# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import torch

from structgstream.kernels.backend import select_backend
from structgstream.scene.appearance import with_appearance
from structgstream.scene.render import render
from structgstream.scene.state import state_of
from tests.support.rigs import arc_rig, random_scene


def test_the_scene_looks_as_before_until_appearance_changes() -> None:
    scene, backend, camera = random_scene(), select_backend("reference"), arc_rig()["cam00"]
    dressed = with_appearance(scene, 4)
    before = render(scene, camera, backend).image
    assert torch.equal(before, render(dressed, camera, backend).image)
    moved = replace(dressed, anchors=replace(dressed.anchors, appearance=torch.ones(len(scene.anchors), 4)))
    assert not torch.allclose(before, render(moved, camera, backend).image, atol=1e-3)


def test_the_basis_is_the_principal_components() -> None:
    """Against the singular values of the centred features; rows are orthogonal, their largest number is positive."""
    scene = random_scene(200)
    features = scene.anchors.features.double()
    wanted = torch.linalg.svdvals(features - features.mean(0))[:5] / len(features) ** 0.5
    basis = state_of(with_appearance(scene, 5))["appearance_basis"].double()
    torch.testing.assert_close(basis @ basis.T, torch.diag(wanted.square()), rtol=1e-5, atol=1e-6)
    assert (basis.gather(1, basis.abs().argmax(1, keepdim=True)) > 0).all()


def test_no_more_directions_than_features() -> None:
    scene = random_scene()
    assert state_of(with_appearance(scene, 1000))["appearance_basis"].shape == (scene.anchors.features.shape[1],) * 2


def test_features_are_f_v_and_the_appearance_which_may_be_folded_into_them() -> None:
    dressed = with_appearance(random_scene(free=3), 4)
    z = torch.randn(len(dressed.anchors), 4, generator=torch.Generator().manual_seed(0))
    changed = replace(dressed, anchors=replace(dressed.anchors, appearance=z))
    torch.testing.assert_close(changed.features, dressed.anchors.features + z @ state_of(dressed)["appearance_basis"])
    folded = changed.with_folded_appearance()
    assert torch.equal(folded.features, changed.features)
    assert folded.appearance_basis is None
    assert folded.anchors.appearance is None
    plain = random_scene()
    assert plain.with_folded_appearance() is plain
