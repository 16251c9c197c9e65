# SPDX-License-Identifier: Apache-2.0
"""FLIP against its authors' package, on natural pictures and on those that are hard."""

import cv2
import numpy as np
import pytest
from flip_evaluator import evaluate

from structgstream.data.dataset_layouts import bundled_clip
from structgstream.evaluation.flip import PIXELS_PER_DEGREE, features_of, flip_map, flip_of

OF_A_PIXEL, OF_THE_MEAN = 5e-4, 5e-5  # of the package's values; the largest seen were 8.9e-5 and 1.4e-5


def noise(seed: int, *, levels: int = 256, shape: tuple[int, int] = (40, 56)) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, levels, (*shape, 3)).astype(np.uint8)


def natural() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Two cameras, and the first of them two frames later."""
    clip = bundled_clip()
    one, other, *_ = clip.rig
    frames = clip.frames()
    first, _, third = (next(frames).images for _ in range(3))
    return first[one], first[other], third[one]


def flip(picture: np.ndarray, truth: np.ndarray) -> float:
    return flip_of(features_of(picture), features_of(truth))


def difference(picture: np.ndarray, truth: np.ndarray) -> tuple[float, float]:
    """Largest of a pixel, and of the mean, from the authors' package."""
    reference, test = (np.divide(p, 255.0, dtype=np.float32) for p in (truth, picture))
    theirs, mean, settings = evaluate(reference, test, "LDR", applyMagma=False)
    assert settings["ppd"] == pytest.approx(PIXELS_PER_DEGREE, abs=1e-3)
    ours = flip_map(features_of(picture), features_of(truth))
    assert ours.shape == truth.shape[:2]
    assert ours.dtype == np.float32
    return float(np.abs(ours - theirs[..., 0]).max()), abs(float(ours.mean(dtype=np.float64)) - mean)


def assert_equal_to_the_package(picture: np.ndarray, truth: np.ndarray) -> None:
    pixel, mean = difference(picture, truth)
    assert pixel < OF_A_PIXEL
    assert mean < OF_THE_MEAN


def test_natural_pictures() -> None:
    one, other, later = natural()
    assert_equal_to_the_package(one, later)
    assert_equal_to_the_package(one, other)
    assert_equal_to_the_package(np.clip(one.astype(np.int16) + 1, 0, 255).astype(np.uint8), one)
    assert_equal_to_the_package(cv2.GaussianBlur(other, (0, 0), 2.0), other)
    assert_equal_to_the_package(one // 32, later // 32)


@pytest.mark.parametrize("levels", [2, 8, 64, 256])
def test_random_pictures_bright_and_nearly_black(levels: int) -> None:
    assert_equal_to_the_package(noise(0, levels=levels), noise(1, levels=levels))


def test_pure_colors_are_clamped_to_what_a_display_has() -> None:
    assert_equal_to_the_package(noise(0, levels=2) * np.uint8(255), noise(1, levels=2) * np.uint8(255))


@pytest.mark.parametrize("shape", [(1, 1), (5, 7), (3, 40), (64, 1)])
def test_borders_are_repeated_in_pictures_smaller_than_the_filters(shape: tuple[int, int]) -> None:
    assert_equal_to_the_package(noise(0, shape=shape), noise(1, shape=shape))


def test_a_picture_that_does_not_lie_in_one_piece_is_read_as_it_is() -> None:
    assert flip(noise(0)[:, ::-1], noise(1)[:, ::-1]) == flip(noise(0)[:, ::-1].copy(), noise(1)[:, ::-1].copy())


def test_results_do_not_depend_on_where_the_memory_lies() -> None:
    expected = flip_map(features_of(noise(0)), features_of(noise(1)))
    held = []
    for size in range(1, 40):
        held.append(bytearray(97 * size))
        np.testing.assert_array_equal(flip_map(features_of(noise(0)), features_of(noise(1))), expected)
