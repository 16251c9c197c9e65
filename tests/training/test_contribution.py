# SPDX-License-Identifier: Apache-2.0
"""What anchors contribute to the pictures."""

from dataclasses import replace

import pytest
import torch

from rigs import arc_rig, random_scene
from structgstream.kernels.backend import reference_backend
from structgstream.training.contribution import contributions

SCENE, RIG, BACKEND = random_scene(30), arc_rig(), reference_backend()
CAMERAS = [RIG[name] for name in RIG.training]


def test_they_are_the_weights_of_an_anchors_gaussians_in_every_picture() -> None:
    found = contributions(SCENE, CAMERAS, scale=1.0, backend=BACKEND)
    expected = torch.zeros(30)
    for camera in CAMERAS:
        gaussians = SCENE.gaussians(camera, BACKEND)
        ones = torch.ones_like(gaussians.means).requires_grad_()
        image = BACKEND.rasterize(replace(gaussians, colors=ones), camera.viewport(gaussians.means)).image
        (weights,) = torch.autograd.grad(image[..., 0].sum(), ones)
        expected.index_add_(0, gaussians.ids // 5, weights[:, 0])
    torch.testing.assert_close(found, expected / expected.mean())
    assert found.mean().item() == pytest.approx(1.0)


def test_smaller_pictures_tell_about_the_same() -> None:
    whole, small = (contributions(SCENE, CAMERAS, scale=scale, backend=BACKEND) for scale in (1.0, 0.5))
    assert (whole - small).abs().max() < 0.2 * whole.max()


def test_a_scene_that_no_camera_sees() -> None:
    assert torch.equal(contributions(SCENE, [], scale=1.0, backend=BACKEND), torch.zeros(30))
