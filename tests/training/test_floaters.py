# SPDX-License-Identifier: Apache-2.0
"""Anchors that float in front of surfaces, and that hardly any camera draws."""

from dataclasses import replace

import torch

from structgstream.kernels.values import HeadWeights, MLPWeights
from structgstream.scene.anchors import AnchorCloud
from structgstream.scene.color import CameraColor
from structgstream.scene.free import FreeGaussians
from structgstream.scene.scene import Scene
from structgstream.training.frame0.regularizers import FreeSpaceConfig, in_free_space
from structgstream.training.views import View
from tests.support.backends import quickest_backend
from tests.support.rigs import arc_rig
from tests.support.varied import varied

CONFIG = varied(FreeSpaceConfig(), MIN_CAMERAS=4, SCALE=1.0)
RIG = arc_rig(9, width=64, height=48)
VIEWS = [View(row, RIG[name], torch.zeros(48, 64, 3, dtype=torch.uint8), None) for row, name in enumerate(RIG.training)]
WIDTH = 8
DIRECTION = slice(WIDTH, WIDTH + 3)


def wall_and(floating: list[tuple[float, float, float]], *, opacity: float, view_dependent: bool = False) -> Scene:
    """An opaque wall behind the origin, and anchors of ``opacity``, with ``view_dependent`` for cam01 alone.

    Feature 0 tells them apart: it is 1 for what floats.
    """
    y, x = torch.meshgrid(torch.linspace(-1.2, 1.2, 25), torch.linspace(-1.6, 1.6, 33), indexing="ij")
    wall = torch.stack([x.flatten(), y.flatten(), torch.full_like(x.flatten(), 0.8)], dim=1)
    positions = torch.cat([wall, torch.tensor(floating).reshape(-1, 3)])
    features = torch.zeros(len(positions), WIDTH)
    features[len(wall) :, 0] = 1.0
    visible = torch.atanh(torch.tensor(0.9))
    w1, w2 = torch.zeros(32, WIDTH + 4), torch.zeros(1, 32)
    w1[0, 0], w2[0, 0] = 1.0, torch.atanh(torch.tensor(opacity)) - visible
    if view_dependent:  # 1 - cos of the angle to the direction from cam01
        towards = torch.tensor(floating[0]) - VIEWS[0].camera.center.float()
        w1[1, 0], w1[1, DIRECTION], w2[0, 1] = 1.0, -torch.nn.functional.normalize(towards, dim=0), -2000.0
    colors, covariances = torch.zeros(3), torch.tensor([6.0, 6.0, 6.0, 1.0, 0.0, 0.0, 0.0])
    still = (torch.zeros(32, WIDTH + 4), torch.zeros(32))
    return Scene(
        anchors=AnchorCloud(
            positions=positions,
            log_offset_scales=torch.zeros(len(positions), 3),
            log_base_scales=torch.full((len(positions), 3), 0.09).log(),
            offsets=torch.zeros(len(positions), 1, 3),
            features=features,
        ),
        mlps=MLPWeights(
            opacity=HeadWeights(w1, torch.zeros(32), w2, visible[None]),
            color=HeadWeights(*still, torch.zeros(3, 32), colors),
            covariance=HeadWeights(*still, torch.zeros(7, 32), covariances),
        ),
        free=FreeGaussians.empty(positions),
        camera_color=CameraColor.identity(len(VIEWS)),
    )


def found(scene: Scene, *, config: FreeSpaceConfig = CONFIG, views: list[View] = VIEWS) -> list[bool]:
    mask = in_free_space(scene, views, config=config, backend=quickest_backend())
    wall = 25 * 33
    assert not mask[:wall].any(), "no surface is in free space"
    return mask[wall:].tolist()


FLOATING = [(0.0, 0.0, -0.6), (0.2, 0.1, -0.2)]


def test_what_no_camera_draws_in_front_of_a_wall_goes() -> None:
    assert found(wall_and(FLOATING, opacity=-0.5)) == [True, True]


def test_what_all_cameras_draw_stays() -> None:
    assert found(wall_and(FLOATING, opacity=0.3)) == [False, False]


def test_what_one_camera_draws_goes() -> None:
    scene = wall_and(FLOATING[:1], opacity=0.4, view_dependent=True)
    drawn = [
        int((scene.structured(view.camera, quickest_backend()).raw_opacities[-1] > CONFIG.DRAWN_OPACITY).sum())
        for view in VIEWS
    ]
    assert drawn == [1] + [0] * (len(VIEWS) - 1)
    assert found(scene) == [True]


def test_what_lies_on_or_behind_a_surface_stays() -> None:
    assert found(wall_and([(0.0, 0.0, 0.78), (0.0, 0.0, 1.2)], opacity=-0.5)) == [False, False]


def test_too_few_cameras_judge_nothing() -> None:
    scene = wall_and(FLOATING, opacity=-0.5)
    assert found(scene, views=VIEWS[:3]) == [False, False]
    assert found(scene, config=varied(CONFIG, MIN_CAMERAS=len(VIEWS) + 1)) == [False, False]
    assert found(scene, views=[]) == [False, False]


def test_where_nothing_is_drawn_nothing_is_in_front_of_it() -> None:
    scene = wall_and(FLOATING, opacity=-0.5)
    alone = scene.anchors.select(torch.arange(25 * 33, len(scene.anchors)))
    mask = in_free_space(replace(scene, anchors=alone), VIEWS, config=CONFIG, backend=quickest_backend())
    assert not mask.any()


def test_pixels_that_do_not_count_judge_nothing() -> None:
    scene = wall_and(FLOATING, opacity=-0.5)
    nothing, everything = torch.zeros(48, 64, dtype=torch.bool), torch.ones(48, 64, dtype=torch.bool)
    assert found(scene, views=[replace(view, mask=nothing) for view in VIEWS]) == [False, False]
    assert found(scene, views=[replace(view, mask=everything) for view in VIEWS]) == [True, True]


def test_smaller_pictures_tell_the_same() -> None:
    assert found(wall_and(FLOATING, opacity=-0.5), config=varied(CONFIG, SCALE=0.5)) == [True, True]
