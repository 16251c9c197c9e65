# SPDX-License-Identifier: Apache-2.0
"""The environment of a scene from its pictures."""

from dataclasses import replace

import torch

from structgstream.environment import environment, pixel_directions
from structgstream.frames import MultiViewFrame
from structgstream.scene.color import CameraColor
from structgstream.scene.render import render
from structgstream.training.frame0.fit import InitialConfig, fit_first_frame
from structgstream.training.frame0.seeding import EnvironmentConfig, fit_environment
from structgstream.training.views import training_views
from tests.support.backends import quickest_backend
from tests.support.rigs import arc_rig, random_scene
from tests.support.varied import varied
from tests.support.worlds import moving_world

BACKEND, RIG = quickest_backend(), arc_rig(5)
TRUTH = torch.tensor([[0.1, 0.0, -0.2], [0.2, 0.1, 0.0], [0.05, 0.3, 0.2], [-0.1, 0.1, 0.1]])


def views(color: CameraColor):
    """Pictures of nothing but an environment, each through its camera's correction."""
    pixels = torch.arange(32 * 48)
    images = {}
    for name in RIG:
        colors = environment(TRUTH, pixel_directions(RIG[name], pixels)).reshape(32, 48, 3)
        if name in RIG.training:
            index = RIG.training.index(name)
            colors = colors * color.gains[index] + color.biases[index]
        images[name] = (colors.clamp(0, 1) * 255).round().to(torch.uint8).numpy()
    images["cam00"] *= 0  # Held out: not to be looked at.
    return training_views(MultiViewFrame(0, 0.0, images), RIG, BACKEND.device)


def test_what_is_behind_nothing_is_found() -> None:
    color = CameraColor(gains=torch.tensor([[0.9] * 3, [1.1] * 3, [1.0] * 3, [1.0] * 3]), biases=torch.zeros(4, 3))
    scene = replace(random_scene(0, cameras=4), camera_color=color)
    config = varied(EnvironmentConfig(), DEGREE=1, SMOOTHNESS=1e-9)
    found = fit_environment(scene, views(color), config=config, backend=BACKEND)
    assert found.shape == (4, 3)
    image = render(replace(scene, environment=found), RIG["cam00"], BACKEND).image
    truth = render(replace(scene, environment=TRUTH), RIG["cam00"], BACKEND).image
    torch.testing.assert_close(image, truth, atol=2 / 255, rtol=0)


def test_it_is_the_same_every_time_and_smooth_where_nobody_looks() -> None:
    color = CameraColor.identity(4)
    scene = random_scene(30, cameras=4)
    one, two = (fit_environment(scene, views(color), config=EnvironmentConfig(), backend=BACKEND) for _ in range(2))
    assert torch.equal(one, two)
    directions = torch.nn.functional.normalize(torch.randn(200, 3, generator=torch.Generator().manual_seed(1)), dim=1)
    smooth = fit_environment(scene, views(color), config=varied(EnvironmentConfig(), SMOOTHNESS=10.0), backend=BACKEND)
    assert environment(smooth, directions).std(0).max() < 0.02 < environment(one, directions).std(0).max()


def test_a_random_background_is_covered_where_cameras_look() -> None:
    """Before black, what is dark is left out; before any colour it is not."""
    world = moving_world(1)
    dark = {name: image // 8 for name, image in world.frames[0].images.items()}
    frame = MultiViewFrame(0, 0.0, dark)
    open_share = []
    for random_background in (False, True):
        config = InitialConfig(
            iterations=80, schedule_iterations=80, voxel_size=0.05, random_background=random_background
        )
        fit = fit_first_frame(frame, world.rig, world.scene.anchors.positions, config=config, backend=BACKEND, seed=0)
        shown = [1.0 - render(fit.scene, world.rig[name], BACKEND).alpha.mean() for name in world.rig.training]
        open_share.append(float(torch.stack(shown).mean()))
    assert open_share[1] < open_share[0] - 0.05
