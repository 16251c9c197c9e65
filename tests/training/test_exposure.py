# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from structgstream.kernels.values import HeadWeights
from structgstream.scene.scene import Scene
from structgstream.training.online.config import ExposureConfig
from structgstream.training.online.exposure import exposure_reference, with_exposure_of
from structgstream.training.views import View
from tests.support.varied import varied
from tests.support.worlds import World, moving_world

CONFIG = varied(ExposureConfig(enabled=True), PICTURE_SCALE=1.0)
WORLD = moving_world(1, cameras=6)  # Five of them train.


def views_of(world: World, change: np.ndarray, *, only: tuple[int, ...] | None = None) -> list[View]:
    """The training views of frame 0, in the views ``only`` with colours whose biases are ``change`` ``[3]`` higher."""
    found = []
    for view in world.views():
        colors = view.colors.clamp(1 / 255, 1 - 1 / 255)
        shifted = torch.sigmoid(torch.logit(colors) + torch.from_numpy(change).float())
        image = (shifted * 255).round().to(torch.uint8)
        found.append(View(view.index, view.camera, image) if only is None or view.index in only else view)
    return found


def change_of(scene: Scene, before: Scene) -> torch.Tensor:
    """Change ``[3]`` of F_c's output biases, the same for all Gaussians of an anchor."""
    change = (scene.mlps.color.b2 - before.mlps.color.b2).reshape(-1, 3)
    assert torch.allclose(change, change[:1].expand_as(change), atol=1e-6), "all of them shift alike"
    return change[0]


def on_grid(scene: Scene, step: float = 1 / 1024) -> Scene:
    """``scene`` with the biases of a stream's, multiples of a step."""
    head = scene.mlps.color
    biases = (head.b2 / step).round() * step
    return replace(scene, mlps=scene.mlps._replace(color=HeadWeights(head.w1, head.b1, head.w2, biases)))


def followed(scene: Scene, views: list[View], *, config: ExposureConfig = CONFIG) -> Scene:
    reference = exposure_reference(WORLD.scene, views_of(WORLD, np.zeros(3)), config=config)
    return with_exposure_of(scene, views, reference, config=config, step=None)


def lit(first: Scene, scene: Scene, change: float, *, config: ExposureConfig = CONFIG, step: float = 1 / 1024) -> Scene:
    """``scene``, of a stream that began with ``first``, in light that is ``change`` higher in all channels."""
    reference = exposure_reference(first, views_of(WORLD, np.zeros(3)), config=config)
    return with_exposure_of(scene, views_of(WORLD, np.full(3, change)), reference, config=config, step=step)


@given(st.tuples(*[st.floats(-0.1, 0.1)] * 3).filter(lambda c: min(map(abs, c)) > 0.02))
def test_a_change_of_light_is_found_in_each_channel(change: tuple[float, float, float]) -> None:
    wanted = np.array(change)
    found = followed(WORLD.scene, views_of(WORLD, wanted))
    assert change_of(found, WORLD.scene).numpy() == pytest.approx(wanted, abs=0.015)
    again = followed(found, views_of(WORLD, wanted))
    assert change_of(again, WORLD.scene).numpy() == pytest.approx(wanted, abs=0.015), "measured from frame 0"


def test_the_same_light_keeps_every_bit() -> None:
    assert followed(WORLD.scene, views_of(WORLD, np.zeros(3))) is WORLD.scene
    faint = varied(CONFIG, MIN_CHANGE=0.05)
    assert followed(WORLD.scene, views_of(WORLD, np.full(3, 0.03)), config=faint) is WORLD.scene


def test_light_that_has_changed_is_followed_in_small_steps() -> None:
    """What is too little to begin with is followed afterwards."""
    first = on_grid(WORLD.scene)
    light = partial(lit, first, config=varied(CONFIG, MIN_CHANGE=0.04, MIN_FURTHER_CHANGE=0.015))
    assert light(first, -0.03) is first
    dark = light(first, -0.06)
    assert light(dark, -0.066) is dark
    darker = light(dark, -0.09)
    assert float((change_of(dark, first) - change_of(darker, first)).min()) > 0.015
    assert light(darker, -0.09) is darker


def test_a_change_of_less_than_half_a_step_changes_nothing() -> None:
    first, config = on_grid(WORLD.scene, step=1 / 16), varied(CONFIG, MIN_CHANGE=0.005)
    assert lit(first, first, -0.02, config=config) is not first
    assert lit(first, first, -0.02, config=config, step=1 / 16) is first


def test_light_that_returns_to_frame_0s_returns_its_bits() -> None:
    first = on_grid(WORLD.scene)
    dark = lit(first, first, -0.06)
    assert float(change_of(dark, first).max()) < -0.04
    back = lit(first, dark, 0.0)
    assert torch.equal(back.mlps.color.b2, first.mlps.color.b2)


def test_biases_lie_on_the_grid_and_nothing_else_changes() -> None:
    scene = on_grid(WORLD.scene)
    found = lit(scene, scene, 0.05)
    bins = found.mlps.color.b2 * 1024
    assert torch.equal(bins, bins.round())
    pairs = zip(found.mlps.color[:3], scene.mlps.color[:3], strict=True)
    assert all(torch.equal(now, then) for now, then in pairs)
    assert found.anchors is scene.anchors
    assert found.free is scene.free


def test_cameras_that_correct_their_exposure_do_not_decide() -> None:
    found = followed(WORLD.scene, views_of(WORLD, np.full(3, -0.08), only=(0, 1, 3)))
    assert float(change_of(found, WORLD.scene).max()) < -0.05
    alone = followed(WORLD.scene, views_of(WORLD, np.full(3, -0.08), only=(2,)))
    assert alone is WORLD.scene, "one camera that fades is no light"


def test_a_switched_light_or_too_few_cameras_change_nothing() -> None:
    assert followed(WORLD.scene, views_of(WORLD, np.full(3, 2.0))) is WORLD.scene
    assert followed(WORLD.scene, views_of(WORLD, np.full(3, 0.08))[:2]) is WORLD.scene


def test_masked_pixels_say_nothing() -> None:
    wanted = np.full(3, 0.08)
    views = views_of(WORLD, wanted)
    half = torch.zeros(views[0].image.shape[:2], dtype=torch.bool)
    half[:, : half.shape[1] // 2] = True
    masked = [View(v.index, v.camera, torch.where(half[..., None], v.image, 0), half) for v in views]
    found = followed(WORLD.scene, masked)
    assert change_of(found, WORLD.scene).numpy() == pytest.approx(wanted, abs=0.02)
