# SPDX-License-Identifier: Apache-2.0
"""Radii and blending weights of the GPU's kernels, run on the processor, beside those of the cpu back-end."""

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch

from structgstream.kernels import cpu_raster, cuda_picture
from structgstream.kernels.cuda_library import KernelLibrary
from structgstream.kernels.native import native_reason
from tests.support.backends import quickest_backend
from tests.support.worlds import moving_world

pytestmark = pytest.mark.skipif(native_reason() is not None, reason=str(native_reason()))


@pytest.mark.parametrize("channels", [1, 7, 9])
@pytest.mark.parametrize("filtered", [False, True])
def test_what_the_cpu_finds(emulation: Callable[[int], KernelLibrary], channels: int, filtered: bool) -> None:
    world = moving_world(2)
    camera = world.rig["cam01"]
    gaussians = world.scene.gaussians(camera, quickest_backend())
    if filtered:
        gaussians = replace(gaussians, sampling_intervals=0.05 + 0.1 * torch.rand(len(gaussians)))
    view = camera.viewport(gaussians.means)
    background = torch.tensor([0.1, 0.2, 0.3])
    maps = torch.rand(camera.height, camera.width, channels, generator=torch.Generator().manual_seed(1))
    found = []
    for order in (0, 1):
        library = emulation(order)
        radii = cuda_picture.projected_radii(library, gaussians, view)
        weights = cuda_picture.blending_weights(library, gaussians, view, maps)
        image, same = cuda_picture.picture_and_weights(library, gaussians, view, maps, background=background)
        assert torch.equal(weights, same)
        found.append((radii, weights, image))
    assert all(torch.equal(one, two) for one, two in zip(*found, strict=True))
    radii, weights, image = found[0]
    assert torch.allclose(radii, cpu_raster.projected_radii(gaussians, view), rtol=1e-5)
    exact, exact_weights = cpu_raster.picture_and_weights(gaussians, view, maps, background=background)
    assert (image - exact).abs().max() < 1e-6
    assert (weights - exact_weights).norm() <= 1e-5 * exact_weights.norm()
