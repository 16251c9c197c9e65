# SPDX-License-Identifier: Apache-2.0
import cv2
import numpy as np
import pytest

from structgstream.preparation.checking.bumps import picture_movement
from tests.support.filmed import noise_texture

SCENE = noise_texture(4, size=320)
SIZE = 240


def view(dx: float = 0.0, dy: float = 0.0, *, degrees: float = 0.0) -> np.ndarray:
    """The middle of the scene, shifted to the right and down, and turned about its middle."""
    motion = cv2.getRotationMatrix2D((SIZE / 2, SIZE / 2), degrees, 1.0)
    motion[:, 2] += motion[:, :2] @ (-40.0, -40.0) + (dx, dy)
    return np.asarray(cv2.warpAffine(SCENE, motion, (SIZE, SIZE)), np.uint8)


def stayed(one: np.ndarray, other: np.ndarray) -> bool:
    found = picture_movement(one, other)
    return found is not None and found.stayed


@pytest.mark.parametrize(("dx", "dy"), [(3.0, 0.0), (-8.0, 6.0)])
def test_a_shift_is_measured(dx: float, dy: float) -> None:
    found = picture_movement(view(), view(dx, dy))
    assert found is not None
    assert found.pixels == pytest.approx(np.hypot(dx, dy), abs=0.1)
    assert found.homography[:2, 2] / found.homography[2, 2] == pytest.approx((dx, dy), abs=0.5)


def test_a_camera_that_stands_still_has_none_though_its_pictures_differ() -> None:
    noise = np.random.default_rng(0).normal(0, 6, view().shape)
    noisy = (0.8 * view() + noise).clip(0, 255).astype(np.uint8)
    assert stayed(view(), noisy)
    assert stayed(view(), view(0.6, 0.0))


def test_a_turn_about_the_axis_is_a_motion() -> None:
    found = picture_movement(view(), view(degrees=4.0))
    assert found is not None
    assert 3 < found.pixels < 10  # keypoints are 40 to 120 pixels from the middle


def test_what_moves_in_the_scene_is_no_motion_of_the_camera() -> None:
    """Even when it covers most of the picture: what stands still does."""
    other = view(9, 0)
    other[:, :80] = view()[:, :80]
    assert stayed(view(), other)


def test_things_that_move_in_several_ways_are_no_motion_of_the_camera() -> None:
    """Nothing stands still, but no one homography is followed by most."""
    bands = [
        view(*shift)[:, 60 * band : 60 * band + 60] for band, shift in enumerate([(9, 0), (0, 9), (-7, 3), (3, -8)])
    ]
    assert picture_movement(view(), np.concatenate(bands, axis=1)) is None


def test_pictures_of_other_things_and_bare_ones_tell_nothing() -> None:
    assert picture_movement(view(), noise_texture(9, size=SIZE)) is None
    assert picture_movement(view(), np.full_like(view(), 90)) is None
