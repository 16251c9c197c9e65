# SPDX-License-Identifier: Apache-2.0
"""Metrics against closed forms and scikit-image, over the pixels that count; scores, also at other sizes."""

import numpy as np
import pytest
import torch
from pytorch_msssim import ms_ssim as their_ms_ssim
from skimage.metrics import peak_signal_noise_ratio

from structgstream.errors import CaptureError
from structgstream.evaluation.evaluate import frames_at_stored_size, half_scores, halved, stored_scores
from structgstream.evaluation.metrics import (
    PSNR_OF_EQUALS,
    ChannelFit,
    changed_pixels,
    channel_fit,
    counting,
    dilate,
    ms_ssim,
    psnr,
    psnr_affine,
    psnr_camera_color,
    score,
    squared_errors,
    ssim,
)
from structgstream.evaluation.pictures import block_mask, block_means
from structgstream.kernels.backend import reference_backend
from structgstream.scene.render import render, to_8bit_image
from tests.support.backends import quickest_backend
from tests.support.rigs import arc_rig
from tests.support.worlds import World, moving_world


def pictures(height: int = 37, width: int = 53) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    truth = rng.integers(0, 256, (height, width, 3))
    truth = (truth + np.roll(truth, 1, 0) + np.roll(truth, 1, 1)) // 3
    noisy = np.clip(truth + rng.normal(0, 12, truth.shape), 0, 255)
    return noisy.astype(np.uint8), truth.astype(np.uint8)


def test_a_rendering_is_clamped_and_rounded_before_it_is_scored() -> None:
    image = torch.tensor([-0.2, 0.0, 0.5, 0.501, 1.0, 1.7]).reshape(1, 2, 3)
    assert to_8bit_image(image).ravel().tolist() == [0, 0, 128, 128, 255, 255]


def test_psnr_agrees_with_scikit_image() -> None:
    picture, truth = pictures()
    assert psnr(picture, truth) == pytest.approx(peak_signal_noise_ratio(truth, picture), abs=1e-9)


def test_the_ssim_of_a_mask_is_the_mean_of_its_pixels() -> None:
    """What the numbers are: kernels/test_reference_losses.py and parity/test_ssim.py."""
    picture, truth = pictures()
    left, right = np.zeros((2, *truth.shape[:2]), bool)
    left[:, :20] = right[:, 20:] = True
    halves = [ssim(picture, truth, quickest_backend(), mask) for mask in (left, right)]
    whole = ssim(picture, truth, quickest_backend())
    assert (20 * halves[0] + 33 * halves[1]) / 53 == pytest.approx(whole, abs=1e-6)
    assert halves[0] != pytest.approx(halves[1], abs=1e-4)


@pytest.mark.parametrize(("height", "width"), [(176, 208), (161, 171), (181, 200)])
def test_ms_ssim_agrees_with_pytorch_msssim(height: int, width: int) -> None:
    picture, truth = pictures(height, width)
    ours, theirs = ms_ssim(picture, truth), []
    for dtype in (torch.float32, torch.float64):
        a, b = (torch.from_numpy(p).permute(2, 0, 1)[None].to(dtype) for p in (picture, truth))
        theirs.append(float(their_ms_ssim(a, b, data_range=255)))
    assert theirs[0] < 0.99
    assert ours == pytest.approx(theirs[1], abs=1e-5)


def test_ms_ssim_of_equals_opposites_and_small_pictures() -> None:
    _, truth = pictures(170, 180)
    assert ms_ssim(truth, truth) == pytest.approx(1.0)
    assert ms_ssim(255 - truth, truth) == 0.0  # negative structure counts as none
    assert ms_ssim(*pictures(160, 200)) is None


def test_squared_errors_are_exact() -> None:
    picture, truth = pictures()
    errors = squared_errors(picture, truth)
    np.testing.assert_array_equal(errors, ((picture.astype(int) - truth.astype(int)) ** 2).sum(2))


def test_a_moved_square_is_found_with_its_rim() -> None:
    first = np.full((40, 40, 3), 50, np.uint8)
    truth = first.copy()
    truth[10:20, 12:22] = 250
    mask = changed_pixels(truth, first)
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    # One pixel beyond the edge a third of the window has changed, by 0.78: above 0.1. Dilation adds three.
    assert (rows[0], rows[-1], columns[0], columns[-1]) == (6, 23, 8, 25)
    assert mask[10:20, 12:22].all()


def test_the_rim_is_as_wide_in_the_scene_in_a_larger_picture() -> None:
    first = np.full((360, 960, 3), 50, np.uint8)
    truth = first.copy()
    truth[100:200, 120:220] = 250
    columns = np.flatnonzero(changed_pixels(truth, first).any(0))
    assert (columns[0], columns[-1]) == (114, 225)  # one pixel of the mean and 3 x 960 / 640, rounded up


@pytest.mark.parametrize(("change", "found"), [(25, False), (26, True)])
def test_the_threshold_is_a_tenth_of_full_scale(change: int, found: bool) -> None:
    first = np.full((16, 16, 3), 100, np.uint8)
    assert changed_pixels(first + np.uint8(change), first).all() == found


def test_noise_of_a_pixel_is_averaged_away() -> None:
    first = np.full((16, 16, 3), 100, np.uint8)
    truth = first.copy()
    truth[8, 8] += 150  # 0.59 of full scale, 0.065 over nine pixels
    assert not changed_pixels(truth, first).any()


def test_dilation_is_a_square_that_stays_in_the_picture() -> None:
    mask = np.zeros((9, 12), bool)
    mask[0, 0] = mask[6, 7] = True
    expected = np.zeros_like(mask)
    expected[:3, :3] = expected[4:9, 5:10] = True
    np.testing.assert_array_equal(dilate(mask, 2), expected)


PLANTED = np.array([[0.8, 0.1, 0.0, 0.05], [0.05, 0.7, 0.1, 0.02], [0.0, -0.05, 0.9, 0.1]])


def picture(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(30, 200, (24, 31, 3)).astype(np.uint8)


def recolored(source: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """``source`` ``[H, W, 3]`` through a 3x4 colour matrix, whose last column is a bias, full scale 1."""
    through = source @ matrix[:, :3].T + 255.0 * matrix[:, 3]
    return np.rint(np.clip(through, 0, 255)).astype(np.uint8)


def test_colour_is_forgiven_and_structure_is_not() -> None:
    source = picture()
    truth = recolored(source, PLANTED)
    assert psnr(source, truth) < 26
    assert psnr_affine(source, truth) > 55  # what rounding leaves
    assert psnr_affine(picture(1), truth) < 20


def test_the_fit_never_loses_on_pictures_inside_the_range() -> None:
    source, truth = picture(), picture(2)
    assert psnr_affine(source, truth) >= psnr(source, truth)


def test_a_picture_of_one_colour_has_a_fit() -> None:
    grey = np.full((6, 7, 3), 90, np.uint8)
    truth = np.full((6, 7, 3), 120, np.uint8)
    assert psnr_affine(grey, truth) > 80


EXPOSURE = ChannelFit(gains=(1.2, 0.8, 1.0), biases=(-0.05, 0.04, 0.0))
IDENTITY = ChannelFit(gains=(1.0, 1.0, 1.0), biases=(0.0, 0.0, 0.0))


def taken(scene: np.ndarray, fit: ChannelFit = EXPOSURE) -> np.ndarray:
    """What a camera of that exposure records."""
    return recolored(scene, np.column_stack([np.diag(fit.gains), fit.biases]))


def test_a_cameras_gain_and_bias_are_found_in_one_frame_and_hold_in_another() -> None:
    fit = channel_fit(picture(), taken(picture()))
    np.testing.assert_allclose(fit.gains, EXPOSURE.gains, atol=1e-3)
    np.testing.assert_allclose(fit.biases, EXPOSURE.biases, atol=1e-3)
    later = picture(1)
    assert psnr(later, taken(later)) < 30
    assert psnr_camera_color(later, taken(later), fit) > 55  # what rounding leaves


def test_a_held_fit_does_not_forgive_light_that_changes_nor_colours_that_mix() -> None:
    fit = channel_fit(picture(), taken(picture()))
    later = picture(1)
    darker = taken(later, ChannelFit(gains=(0.6, 0.6, 0.6), biases=EXPOSURE.biases))
    assert psnr_camera_color(later, darker, fit) < 20 < psnr_affine(later, darker)
    mixed = recolored(later, PLANTED)
    assert psnr_camera_color(later, mixed, channel_fit(later, mixed)) < psnr_affine(later, mixed) - 10


def test_the_identity_leaves_psnr_as_it_is_and_the_fit_of_a_frame_does_not_lower_it() -> None:
    source, truth = picture(), picture(2)
    assert psnr_camera_color(source, truth, IDENTITY) == pytest.approx(psnr(source, truth))
    assert psnr_camera_color(source, truth, channel_fit(source, truth)) >= psnr(source, truth)
    assert psnr_camera_color(source, source, IDENTITY) == PSNR_OF_EQUALS


def test_a_channel_of_one_value_is_shifted_and_not_stretched() -> None:
    grey, truth = np.full((6, 7, 3), 90, np.uint8), picture()[:6, :7]
    fit = channel_fit(grey, truth)
    assert fit.gains == (1.0, 1.0, 1.0)
    np.testing.assert_allclose(fit.biases, truth.mean((0, 1)) / 255 - 90 / 255, atol=1e-12)


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
