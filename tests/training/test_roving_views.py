# SPDX-License-Identifier: Apache-2.0
"""Pictures of a roving camera in frame 0: views by turns, gains."""

from dataclasses import replace
from itertools import islice

import numpy as np
import pytest
import torch

from structgstream.cameras import CameraRig
from structgstream.frames import MultiViewFrame, RovingPicture
from structgstream.scene.render import Rendering
from structgstream.training.frame0.fit import fit_first_frame
from structgstream.training.frame0.roving import RovingViews, alternating
from structgstream.training.views import View
from tests.support.backends import quickest_backend
from tests.support.rigs import arc_rig, random_scene
from tests.support.worlds import World, moving_world
from tests.training.test_initial import QUICK

CPU = torch.device("cpu")
HEIGHT, WIDTH = 72, 96


def walked(world: World, *, names: tuple[str, ...], gain: float = 1.0) -> list[RovingPicture]:
    """Pictures of these cameras of ``world`` as a roving camera's."""
    found = []
    for name in names:
        image = (world.frames[0].images[name] * gain).round().astype(np.uint8)
        found.append(RovingPicture(world.rig[name], image, np.ones(image.shape[:2], bool)))
    return found


def few_cameras(world: World) -> tuple[MultiViewFrame, CameraRig]:
    """The first frame as two training cameras at one end see it; ``cam00`` at the other end is held out."""
    names = ("cam00", *world.rig.training[-2:])
    rig = CameraRig({name: world.rig[name] for name in names}, frozenset({"cam00"}))
    return replace(world.frames[0], images={name: world.frames[0].images[name] for name in names}), rig


def test_views_between_the_cameras_help_a_held_out_one() -> None:
    world = moving_world(1, cameras=7)
    frame, rig = few_cameras(world)
    roving = walked(world, names=world.rig.training[:-2])
    points, backend = world.scene.anchors.positions, quickest_backend()
    config = replace(QUICK, camera_color=True)
    scores = []
    for pictures in ((), roving):
        fit = fit_first_frame(frame, rig, points, config=config, backend=backend, seed=0, roving=pictures)
        assert fit.scene.camera_color.gains.shape == (2, 3)  # of the training cameras alone
        scores.append(world.psnr(fit.scene))
    assert scores[1] > scores[0] + 1.0


def test_the_exposure_of_the_roving_camera_is_not_the_scene_s() -> None:
    world = moving_world(1, cameras=7)
    frame, rig = few_cameras(world)
    points, backend = world.scene.anchors.positions, quickest_backend()
    dark = walked(world, names=world.rig.training[:-2], gain=0.6)
    scores = {}
    for colors in (True, False):
        config = replace(QUICK, camera_color=colors)
        fit = fit_first_frame(frame, rig, points, config=config, backend=backend, seed=0, roving=dark)
        scores[colors] = world.psnr(fit.scene)
    assert scores[True] > scores[False] + 1.0


def test_views_come_by_turns() -> None:
    world = moving_world(1)
    still = world.views()
    roving = RovingViews.of(walked(world, names=("cam00",)), first=len(still), fits_gains=True, device=CPU)
    generator = torch.Generator().manual_seed(0)
    taken = [*islice(alternating(still, roving.views, [(6, 0.5)], generator=generator), 12)]
    assert [roving.has(view) for view in taken] == [False, True] * 6
    assert [view.camera.width for view in taken] == [24] * 6 + [48] * 6


@pytest.fixture
def one() -> tuple[RovingViews, View, torch.Tensor]:
    """A roving picture, darker than what is drawn; what is masked in it is black."""
    drawn = torch.rand(HEIGHT, WIDTH, 3, generator=torch.Generator().manual_seed(0)) * 0.4 + 0.3
    truth = drawn * torch.tensor([0.8, 0.7, 0.9])
    truth[20:40, 30:50] = 0.0
    image = (truth * 255).round().to(torch.uint8).numpy()
    mask = np.ones((HEIGHT, WIDTH), bool)
    mask[20:40, 30:50] = False
    camera = next(iter(arc_rig(4, width=WIDTH, height=HEIGHT).cameras.values()))
    views = RovingViews.of([RovingPicture(camera, image, mask)], first=3, fits_gains=True, device=CPU)
    return views, views.views[0], drawn


def rendering(image: torch.Tensor, *, alpha: float = 1.0) -> Rendering:
    coverage = torch.full(image.shape[:2], alpha)
    gaussians = random_scene(3).gaussians(next(iter(arc_rig(4).cameras.values())), quickest_backend())
    return Rendering(image, coverage, torch.zeros(0), gaussians, None)


def test_gains_fit_where_the_picture_counts(one: tuple[RovingViews, View, torch.Tensor]) -> None:
    views, view, drawn = one
    views.fit_gains(view, rendering(drawn), share=0.1)
    torch.testing.assert_close(views.gains[0], torch.tensor([0.8, 0.7, 0.9]), atol=0.02, rtol=0)
    scene, shown = views.applied(random_scene(3, cameras=3), view)
    assert shown.index == 3
    torch.testing.assert_close(scene.camera_color.gains[3], views.gains[0])


def test_gains_stay_early_and_where_the_scene_is_not_yet(one: tuple[RovingViews, View, torch.Tensor]) -> None:
    views, view, drawn = one
    views.fit_gains(view, rendering(drawn), share=0.01)
    views.fit_gains(view, rendering(drawn, alpha=0.1), share=0.6)
    assert torch.equal(views.gains, torch.ones(1, 3))
