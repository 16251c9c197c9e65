# SPDX-License-Identifier: Apache-2.0
"""What is behind a scene."""

from dataclasses import replace

import pytest
import torch

from structgstream.environment import environment, pixel_directions
from structgstream.kernels.backend import reference_backend
from structgstream.scene.render import draw, render
from tests.support.rigs import arc_rig, random_scene
from tests.support.spheres import fibonacci_sphere

BACKEND, CAMERA = reference_backend(), arc_rig()["cam01"]


@pytest.mark.parametrize("rows", [1, 4, 9])
def test_colours_are_within_bounds_and_constant_without_coefficients(rows: int) -> None:
    directions = fibonacci_sphere(50)
    none = torch.zeros(rows, 3, dtype=torch.float64)
    assert torch.equal(environment(none, directions), torch.full((50, 3), 0.5, dtype=torch.float64))
    colors = environment(none + 9.0, directions)
    assert 0.0 <= colors.min() <= colors.max() == 1.0


def test_directions_are_those_of_what_a_pixel_shows() -> None:
    pixels = torch.tensor([[0, 0], [31, 47], [16, 24]])  # rows and columns
    points = CAMERA.center + 3.0 * pixel_directions(CAMERA, pixels @ torch.tensor([48, 1]))
    seen = points @ CAMERA.viewmat[:3, :3].T + CAMERA.viewmat[:3, 3]
    shown = (seen @ CAMERA.K.T)[:, :2] / seen[:, 2:]
    torch.testing.assert_close(shown, pixels.flip(1).double() + 0.5, atol=1e-4, rtol=0)


def test_it_is_seen_through_what_coverage_leaves() -> None:
    scene, coefficients = random_scene(free=2), torch.randn(9, 3, generator=torch.Generator().manual_seed(0)) / 4
    black, behind = render(scene, CAMERA, BACKEND), render(replace(scene, environment=coefficients), CAMERA, BACKEND)
    pixels = torch.arange(32 * 48)
    colors = environment(coefficients, pixel_directions(CAMERA, pixels)).reshape(32, 48, 3)
    expected = black.image + (1.0 - black.alpha[..., None]) * colors
    torch.testing.assert_close(behind.image, expected, atol=0.5 / 255, rtol=0)
    assert torch.equal(behind.alpha, black.alpha)
    assert (behind.image - black.image).max() > 0.2


def test_a_smooth_one_is_nearly_one_colour_for_a_picture() -> None:
    """What a trainer draws on (``background``) is what a viewer sees, where coverage leaves a few percent."""
    scene = replace(random_scene(free=2), environment=torch.tensor([[0.2] * 3, [0.1] * 3, [-0.1] * 3, [0.05] * 3]))
    color = scene.background(CAMERA)
    assert color is not None
    trained = draw(scene.gaussians(CAMERA, BACKEND), CAMERA, BACKEND, background=color)
    covered = trained.alpha > 0.9
    assert covered.any()
    shown = render(scene, CAMERA, BACKEND).image
    torch.testing.assert_close(trained.image[covered], shown[covered], atol=1 / 255, rtol=0)
    assert replace(scene, environment=None).background(CAMERA) is None
