# SPDX-License-Identifier: Apache-2.0
import torch

from structgstream.kernels.backend import reference_backend
from structgstream.scene.render import draw, render
from tests.support.rigs import arc_rig, random_scene


def test_rendering_has_the_cameras_size_and_no_graph() -> None:
    output = render(random_scene(free=2), arc_rig()["cam01"], reference_backend())
    assert output.image.shape == (32, 48, 3)
    assert output.alpha.shape == (32, 48)
    assert not output.image.requires_grad
    assert output.alpha.max() > 0.1


def test_the_screen_gradient_is_the_gradient_of_the_projected_mean() -> None:
    """Moving the camera's principal point moves every Gaussian on screen alike: the gradients must add up to it."""
    scene, camera, backend = random_scene(30), arc_rig()["cam01"], reference_backend()
    gaussians = scene.gaussians(camera, backend)
    target = torch.rand(32, 48, 3)
    rendering = draw(gaussians, camera, backend, track_screen=True)
    (rendering.image * target).sum().backward()
    offsets = torch.full_like(gaussians.means[:, :2], 0.0)
    step = 0.02
    sums = []
    for sign in (1, -1):
        offsets[:, 0] = sign * step
        moved = backend.rasterize(gaussians, camera.viewport(gaussians.means), screen_offsets=offsets)
        sums.append((moved.image * target).sum())
    assert rendering.screen_offsets is not None
    assert rendering.screen_offsets.grad is not None
    total = rendering.screen_offsets.grad[:, 0].sum()
    assert torch.allclose(total, (sums[0] - sums[1]) / (2 * step), rtol=0.05)
