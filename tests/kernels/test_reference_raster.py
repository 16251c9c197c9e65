# SPDX-License-Identifier: Apache-2.0
"""The oracle against closed forms and against finite differences."""

import math

import pytest
import torch

from structgstream.kernels.reference_raster import blending_weights, rasterize
from tests.support.splats import splats_of, viewport_of

K = torch.tensor([[50.0, 0, 16.5], [0, 50.0, 12.5], [0, 0, 1]], dtype=torch.float64)
EYE = torch.eye(4, dtype=torch.float64)
VIEW = viewport_of(EYE, K, width=33, height=25, near=0.1)


def draw(means, scales, opacities, colors, *, quats=None, near=0.1, **options):
    n = len(means)
    means, scales, opacities, colors = (
        torch.as_tensor(t, dtype=torch.float64) for t in (means, scales, opacities, colors)
    )
    quats = torch.tensor([[1.0, 0, 0, 0]], dtype=torch.float64).expand(n, 4) if quats is None else quats
    return rasterize(splats_of(means, quats, scales, opacities, colors), VIEW._replace(near=near), **options)


def test_one_gaussian_has_the_projected_gaussian_profile() -> None:
    output = draw([[0.0, 0.0, 2.0]], [[0.1, 0.2, 0.05]], [0.8], [[1.0, 0.5, 0.25]])
    # Centre pixel (16, 12): its centre is the principal point. Variances (f s / z)^2 + 0.3.
    assert output.image[12, 16].tolist() == pytest.approx([0.8, 0.4, 0.2])
    for dx, dy in ((3, 0), (0, 4), (-2, 2)):
        power = -0.5 * (dx**2 / (2.5**2 + 0.3) + dy**2 / (5.0**2 + 0.3))
        assert output.alpha[12 + dy, 16 + dx].item() == pytest.approx(0.8 * math.exp(power))


def test_the_nearer_gaussian_covers_the_farther() -> None:
    output = draw([[0, 0, 3.0], [0, 0, 2.0]], [[0.3] * 3, [0.2] * 3], [0.9, 0.6], [[0, 1.0, 0], [1.0, 0, 0]])
    assert output.image[12, 16].tolist() == pytest.approx([0.6, 0.4 * 0.9, 0.0])
    assert output.alpha[12, 16].item() == pytest.approx(1 - 0.4 * 0.1)


def test_the_background_shows_through() -> None:
    background = torch.tensor([0.2, 0.4, 0.6], dtype=torch.float64)
    output = draw([[0, 0, 2.0]], [[0.1] * 3], [0.5], [[1.0, 1.0, 1.0]], background=background)
    assert output.image[12, 16].tolist() == pytest.approx([0.6, 0.7, 0.8])
    assert output.image[0, 0].tolist() == pytest.approx([0.2, 0.4, 0.6])


def test_what_is_too_near_behind_or_broken_is_not_drawn() -> None:
    means = [[0, 0, 0.05], [0, 0, -2.0], [math.nan, 0, 2.0], [0, 0, 2.0], [50.0, 0, 2.0]]
    output = draw(means, [[0.1] * 3] * 5, [0.5] * 5, [[1.0] * 3] * 5)
    assert (output.radii > 0).tolist() == [False, False, False, True, False]
    assert torch.isfinite(output.image).all()


def test_nothing_gives_the_background() -> None:
    output = draw(torch.zeros(0, 3), torch.zeros(0, 3), torch.zeros(0), torch.zeros(0, 3))
    assert output.image.abs().sum() == 0
    assert output.radii.shape == (0,)


def test_opaque_layers_stop_the_pixel() -> None:
    n = 40
    means = torch.zeros(n, 3, dtype=torch.float64)
    means[:, 2] = torch.linspace(2, 4, n)
    output = draw(means, torch.full((n, 3), 0.5), torch.full((n,), 0.95), torch.ones(n, 3))
    # 0.05^3 is above the limit of 1e-4, 0.05^4 below it: the fourth layer is not blended.
    assert output.alpha[12, 16].item() == pytest.approx(1 - 0.05**3, abs=1e-6)


@pytest.mark.parametrize("channels", [1, 2, 3, 4, 5, 8, 9])
def test_blending_weights_are_the_pictures_of_each_gaussian_alone_in_its_colour(channels: int) -> None:
    means = torch.tensor([[0, 0, 3.0], [0.1, 0, 2.0], [-0.2, 0.1, 2.5]], dtype=torch.float64)
    scales, opacities = torch.full((3, 3), 0.2, dtype=torch.float64), torch.tensor([0.9, 0.6, 0.4], dtype=torch.float64)
    quats = torch.tensor([[1.0, 0, 0, 0]], dtype=torch.float64).expand(3, 4)
    pictures = draw(means, scales, opacities, torch.eye(3)).image
    maps = torch.rand(25, 33, channels, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    found = blending_weights(splats_of(means, quats, scales, opacities, torch.zeros_like(means)), VIEW, maps)
    assert found.shape == (3, channels)
    assert torch.allclose(found, torch.einsum("hwn,hwc->nc", pictures, maps), rtol=1e-12)


def test_gradients_are_those_of_finite_differences() -> None:
    generator = torch.Generator().manual_seed(2)
    n = 6
    means = (torch.rand(n, 3, generator=generator, dtype=torch.float64) - 0.5) * 0.5
    means[:, 2] = 2.0 + 0.3 * torch.arange(n)  # Depths far apart: no order changes under a small step.
    inputs = (
        means,
        torch.randn(n, 4, generator=generator, dtype=torch.float64),
        0.1 + 0.2 * torch.rand(n, 3, generator=generator, dtype=torch.float64),
        0.3 + 0.4 * torch.rand(n, generator=generator, dtype=torch.float64),
        torch.rand(n, 3, generator=generator, dtype=torch.float64),
        torch.zeros(n, 2, dtype=torch.float64),
    )
    inputs = tuple(value.requires_grad_() for value in inputs)
    rows, columns = slice(9, 16), slice(12, 21)  # Near the middle, where every alpha is well above 1/255.

    def centre(means, quats, scales, opacities, colors, offsets):
        output = rasterize(splats_of(means, quats, scales, opacities, colors), VIEW, screen_offsets=offsets)
        return output.image[rows, columns], output.alpha[rows, columns]

    # The fast mode compares products with random vectors, so every input and output counts at once.
    assert torch.autograd.gradcheck(centre, inputs, eps=1e-6, atol=1e-5, rtol=1e-4, fast_mode=True)
