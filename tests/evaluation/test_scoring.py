# SPDX-License-Identifier: Apache-2.0
"""The scores of a picture (``test_metrics`` and ``test_masks`` have each of them by itself). Scores at half the size
and at the stored size, of scenes that are drawn exactly."""

import numpy as np
import pytest
import torch

from structgstream.errors import CaptureError
from structgstream.evaluation.evaluate import frames_at_stored_size, half_scores, halved, stored_scores
from structgstream.evaluation.metrics import PSNR_OF_EQUALS, counting, score
from structgstream.evaluation.pictures import block_mask, block_means
from structgstream.kernels.backend import reference_backend
from structgstream.scene.render import render, to_8bit_image
from tests.support.backends import quickest_backend
from tests.support.rigs import arc_rig
from tests.support.worlds import World, moving_world


def test_every_pixel_changed_leaves_no_still_one() -> None:
    dark, bright = np.zeros((8, 8, 3), np.uint8), np.full((8, 8, 3), 200, np.uint8)
    scores = score(bright, bright, dark, backend=reference_backend())
    assert (scores.changed_share, scores.psnr_still) == (1.0, None)
    assert scores.psnr_changed == PSNR_OF_EQUALS


def test_pictures_of_different_sizes_are_reported() -> None:
    small, large = np.zeros((8, 9, 3), np.uint8), np.zeros((16, 18, 3), np.uint8)
    with pytest.raises(CaptureError, match="9x8 pixels .* truth of 18x16"):
        score(small, large, large, backend=reference_backend())


def test_what_a_mask_leaves_out_does_not_count() -> None:
    random = np.random.default_rng(0)
    first, truth = (random.integers(0, 256, (24, 32, 3), np.uint8) for _ in range(2))
    mask = np.zeros((24, 32), bool)
    mask[:, :20] = True
    picture = np.where(mask[..., None], truth, 0).astype(np.uint8)
    scores = score(picture, np.where(mask[..., None], truth, 0).astype(np.uint8), first, backend=reference_backend(),
                   mask=mask)  # fmt: skip
    assert scores.psnr == PSNR_OF_EQUALS
    assert counting(mask, truth)[0].shape == (24 * 20, 1, 3)
    assert counting(None, truth)[0] is truth


@pytest.fixture(scope="module")
def world() -> World:
    return moving_world(frames=2, speed=0.03)


@pytest.mark.parametrize("factor", [1, 2, 3, 5])
def test_blocks_are_means_and_what_fills_none_is_left_out(factor: int) -> None:
    picture = np.random.default_rng(0).integers(0, 256, (31, 47, 3)).astype(np.uint8)
    small = block_means(picture, factor)
    height, width = 31 // factor, 47 // factor
    whole = picture[: height * factor, : width * factor].reshape(height, factor, width, factor, 3)
    np.testing.assert_allclose(small, whole.mean((1, 3)), atol=0.5)
    mask = np.ones((31, 47), np.bool_)
    mask[7, 9] = False
    reduced = block_mask(mask, factor)
    assert reduced.shape == (height, width)
    assert np.argwhere(~reduced).tolist() == [[7 // factor, 9 // factor]]


def test_half_of_an_odd_picture_shows_the_same_places() -> None:
    camera = arc_rig(3, width=47, height=31)["cam01"]
    half = halved(camera)
    assert (half.width, half.height) == (23, 15)
    point = torch.tensor([0.1, -0.2, 2.0], dtype=torch.float64)
    torch.testing.assert_close((half.K @ point)[:2] * 2, (camera.K @ point)[:2])


def test_half_size_compares_with_the_mean_of_the_truth(world: World) -> None:
    """A truth whose area mean is the small rendering scores as equal; one that is brighter as its offset says."""
    backend, camera = quickest_backend(), world.rig["cam00"]
    small = to_8bit_image(render(world.scene, halved(camera), backend).image)
    truth = small.repeat(2, 0).repeat(2, 1)
    scores = half_scores(world.scene, camera, truth, backend=backend)
    assert scores["psnr_half"] == PSNR_OF_EQUALS
    assert scores["ssim_half"] == pytest.approx(1.0)
    dark = np.where(truth > 20, truth - 20, truth).astype(np.uint8)
    mask = np.min(truth, axis=2) > 20
    masked = half_scores(
        world.scene, camera, np.where(mask[..., None], dark, 0).astype(np.uint8), backend=backend, mask=mask
    )
    assert masked["psnr_half"] == pytest.approx(20 * np.log10(255 / 20))


def test_the_stored_size_is_scored_in_few_spread_frames(world: World) -> None:
    """What is seen where: test_evaluate.py."""
    assert frames_at_stored_size(20) == [0, 5, 10, 14, 19]
    assert frames_at_stored_size(3) == [2]
    backend, camera = quickest_backend(), world.rig["cam00"]
    picture = to_8bit_image(render(world.scene, camera.resized(96, 64), backend).image)
    scores = stored_scores(world.scene, camera, picture, backend=backend)
    assert scores == pytest.approx({"psnr_stored": PSNR_OF_EQUALS, "ssim_stored": 1.0})
