# SPDX-License-Identifier: Apache-2.0
import cv2
import numpy as np
import pytest

from filmed import noise_texture
from structgstream.preparation.checking.stillness import picture_shift, stillness_findings

SCENE = noise_texture(4, size=320)
SIZE = 240


def view(dx: float = 0.0, dy: float = 0.0, *, degrees: float = 0.0) -> np.ndarray:
    """The middle of the scene, shifted to the right and down, and turned about its middle."""
    motion = cv2.getRotationMatrix2D((SIZE / 2, SIZE / 2), degrees, 1.0)
    motion[:, 2] += motion[:, :2] @ (-40.0, -40.0) + (dx, dy)
    return np.asarray(cv2.warpAffine(SCENE, motion, (SIZE, SIZE)), np.uint8)


@pytest.mark.parametrize(("dx", "dy"), [(3.0, 0.0), (-8.0, 6.0)])
def test_a_shift_is_measured(dx: float, dy: float) -> None:
    assert picture_shift(view(), view(dx, dy)) == pytest.approx(np.hypot(dx, dy), abs=0.1)


def test_a_camera_that_stands_still_has_none_though_its_pictures_differ() -> None:
    noise = np.random.default_rng(0).normal(0, 6, view().shape)
    noisy = (0.8 * view() + noise).clip(0, 255).astype(np.uint8)
    assert picture_shift(view(), noisy) is None
    assert picture_shift(view(), view(0.6, 0.0)) is None


def test_a_turn_about_the_axis_is_a_motion() -> None:
    found = picture_shift(view(), view(degrees=4.0))
    assert found is not None
    assert 3 < found < 10  # keypoints are 40 to 120 pixels from the middle


def test_what_moves_in_the_scene_is_no_motion_of_the_camera() -> None:
    """Even when it covers most of the picture: what stands still does."""
    other = view(9, 0)
    other[:, :80] = view()[:, :80]
    assert picture_shift(view(), other) is None


def test_things_that_move_in_several_ways_are_no_motion_of_the_camera() -> None:
    """Nothing stands still, but no one homography is followed by most."""
    bands = [
        view(*shift)[:, 60 * band : 60 * band + 60] for band, shift in enumerate([(9, 0), (0, 9), (-7, 3), (3, -8)])
    ]
    assert picture_shift(view(), np.concatenate(bands, axis=1)) is None


def test_pictures_of_other_things_and_bare_ones_tell_nothing() -> None:
    assert picture_shift(view(), noise_texture(9, size=SIZE)) is None
    assert picture_shift(view(), np.full_like(view(), 90)) is None


def test_findings_are_of_the_cameras_that_have_both_pictures() -> None:
    first = {"a": view(), "b": view(), "c": view()}
    (found,) = stillness_findings(first, {"b": view(5, 0), "a": view()}, frames=(3, 90))
    assert (found.severity, found.cameras) == ("error", ("b",))
    assert "'b' was bumped between frame 3 and frame 90" in found.sentence
    assert "shifted by 5.0 pixels" in found.sentence
