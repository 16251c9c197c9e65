# SPDX-License-Identifier: Apache-2.0
"""What renderings miss beyond what they missed in frame 0."""

from dataclasses import replace

import pytest
import torch
from torch.nn.functional import avg_pool2d

from structgstream.training.online.config import MotionConfig
from structgstream.training.residuals import (
    BaselineResidual,
    apply_camera_color,
    baseline_residual,
    box_mean,
    recorded,
    residuals,
)
from structgstream.training.views import blackened
from tests.support.backends import quickest_backend
from tests.support.varied import varied
from tests.support.worlds import moved_since, moving_world

WORLD = moving_world(3, speed=0.06, movers=20)
BACKEND, views = quickest_backend(), WORLD.views


@pytest.mark.parametrize(("size", "pixels"), [((9, 14), 3), ((9, 14), 5), ((2, 14), 7), ((1, 1), 5)])
def test_a_mean_over_a_box_is_torchs(size: tuple[int, int], pixels: int) -> None:
    values = torch.rand(size, generator=torch.Generator().manual_seed(1))
    expected = avg_pool2d(values[None, None], pixels, stride=1, padding=pixels // 2, count_include_pad=False)[0, 0]
    torch.testing.assert_close(box_mean(values, pixels), expected, rtol=1e-6, atol=1e-6)


def test_a_rendering_is_compared_as_its_camera_would_have_recorded_it() -> None:
    color = replace(WORLD.scene.camera_color, gains=torch.full((4, 3), 2.0), biases=torch.full((4, 3), 0.1))
    torch.testing.assert_close(apply_camera_color(torch.full((2, 2, 3), 0.3), color, 1), torch.full((2, 2, 3), 0.7))
    view = views(0)[1]
    drawn = (view.colors - 0.1) / 2.0
    assert residuals([drawn], [view], color, BACKEND).max() < 1e-6
    assert residuals([view.colors], [view], color, BACKEND).mean() > 0.05


def test_gradients_of_a_recorded_rendering_are_those_of_its_formula() -> None:
    generator = torch.Generator().manual_seed(1)
    numbers = [torch.rand(size, generator=generator) for size in ((5, 7, 3), (3,), (3,))]
    image, gains, biases = (values.requires_grad_() for values in numbers)
    weights = torch.rand(5, 7, 3, generator=generator)
    found, expected = (
        torch.autograd.grad(values, [image, gains, biases], weights)
        for values in (recorded(image, gains, biases), image * gains + biases)
    )
    torch.testing.assert_close(found, expected)


def test_the_baseline_is_what_frame_0_missed_nearby() -> None:
    spoiled = views()
    image = spoiled[1].image.clone()
    image[10, 20] = 255 - image[10, 20]
    spoiled[1] = replace(spoiled[1], image=image)
    clean, baseline = (baseline_residual(WORLD.scene, v, scale=1.0, backend=BACKEND).maps for v in (views(0), spoiled))
    assert torch.equal(clean[0], baseline[0])
    more = baseline[1] - clean[1]
    assert (more[8:13, 18:23] > 0.01).all()
    assert not more[:6].any()


def test_the_baseline_is_at_most_the_usual_one_where_pictures_have_changed() -> None:
    baseline = torch.tensor([[0.1, 0.2, 0.3, 0.4, 0.5, 1.0]])  # The last pixel is masked.
    changed = torch.tensor([[True, True, True, True, False, False]])
    capped = BaselineResidual(1.0, {3: baseline, 4: baseline}).capped({3: changed}, medians=1.0).maps
    torch.testing.assert_close(capped[3], torch.tensor([[0.1, 0.2, 0.3, 0.3, 0.5, 1.0]]))
    assert torch.equal(capped[4], baseline), "nothing is known of its changes"
    none = BaselineResidual(1.0, {3: baseline}).capped({3: changed}, medians=0.0).maps[3]
    assert not none[changed].any()
    masked = torch.ones(1, 6)
    assert torch.equal(BaselineResidual(1.0, {3: masked}).capped({3: changed}, medians=1.0).maps[3], masked)


def test_slow_change_is_seen_by_the_residual_alone() -> None:
    """Between two equal pictures nothing changed, but the scene was left behind a frame ago."""
    baseline = baseline_residual(WORLD.scene, views(0), scale=1.0, backend=BACKEND)
    config = varied(MotionConfig(enabled=True, picture_scale=1.0, residual_threshold=0.05), REACH_PIXELS=1)

    def found(threshold: float):
        wanted = replace(config, residual_threshold=threshold)
        return moved_since(WORLD.scene, views(1), views(1), config=wanted, backend=BACKEND, baseline=baseline)

    assert not found(0.0).anchors.any()
    lagging = found(0.05).anchors
    assert lagging[:20].float().mean() > 0.7
    assert lagging[20:].float().mean() < lagging[:20].float().mean() - 0.1


def test_what_frame_0_already_missed_does_not_count() -> None:
    other = moving_world(1, movers=0)
    wrong = replace(WORLD.scene, anchors=replace(WORLD.scene.anchors, positions=WORLD.scene.anchors.positions + 0.05))
    seen = other.views()
    baseline = baseline_residual(wrong, seen, scale=1.0, backend=BACKEND)
    config = varied(MotionConfig(enabled=True, picture_scale=1.0, residual_threshold=0.05), REACH_PIXELS=1)
    assert not moved_since(wrong, seen, seen, config=config, backend=BACKEND, baseline=baseline).anchors.any()
    free_of_it = replace(baseline, maps={index: torch.zeros_like(values) for index, values in baseline.maps.items()})
    assert moved_since(wrong, seen, seen, config=config, backend=BACKEND, baseline=free_of_it).anchors.any()


def test_masked_pixels_miss_nothing_and_their_baseline_is_out_of_reach() -> None:
    mask = torch.ones(32, 48, dtype=torch.bool)
    mask[5:20, 10:30] = False
    spoiled = [replace(view, image=blackened(view.image, mask), mask=mask) for view in views(0)]
    picture = torch.rand(32, 48, 3, generator=torch.Generator().manual_seed(0))
    color = WORLD.scene.camera_color
    (found,) = residuals([picture], spoiled[:1], color, BACKEND)
    assert not found[~mask].any()
    elsewhere = torch.where(mask[..., None], picture, 0.5)
    assert torch.equal(found, residuals([elsewhere], spoiled[:1], color, BACKEND)[0])
    baseline = baseline_residual(WORLD.scene, spoiled, scale=1.0, backend=BACKEND).maps
    assert (baseline[0][~mask] == 1.0).all()
    clean = baseline_residual(WORLD.scene, views(0), scale=1.0, backend=BACKEND).maps
    torch.testing.assert_close(baseline[0][24:], clean[0][24:])
