# SPDX-License-Identifier: Apache-2.0
"""A thing that moves before a plain background, and cameras that are bumped."""

from collections.abc import Sequence
from functools import cache

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from structgstream.cameras import Camera
from structgstream.frames import MultiViewFrame
from structgstream.pose_check.check import Finding
from structgstream.pose_check.tracks import gather
from structgstream.preparation.checking.bumps import GONE, bump_findings, picture_movement
from tests.support.filmed import Film, Plane, noise_texture, ring, room, turned

Pictures = dict[str, NDArray[np.uint8]]


@cache
def rig() -> dict[str, Film]:
    return {
        name: Film(filmed) for name, filmed in ring(4, radius=2.6, arc_degrees=30, focal=290, size=(320, 240)).items()
    }


def cameras() -> dict[str, Camera]:
    return {name: film.filmed.camera for name, film in rig().items()}


def sheet(yaw: float, middle: tuple[float, float, float], texture: int = 5) -> Plane:
    """A picture of a metre and a half that is held into the room."""
    pose = np.eye(4)
    pose[:3, :3] = turned(yaw, axis=1)
    pose[:3, 3] = np.array(middle) - pose[:3, :3] @ [0.75, 0.75, 0.0]
    return Plane(noise_texture(texture), pose, (1.5, 1.5))


def filmed(planes: Sequence[Plane], seed: int) -> Pictures:
    return {
        name: film.picture(planes, noise=1, seed=seed + number) for number, (name, film) in enumerate(rig().items())
    }


def findings(before: Pictures, after: Pictures) -> list[Finding]:
    first, last = (MultiViewFrame(index, index / 30, images) for index, images in ((0, before), (9, after)))
    return bump_findings(first, last, gather(first, cameras()), cameras())


@cache
def moving_sheet() -> tuple[Pictures, Pictures]:
    return filmed([sheet(0, (0, 0, 0))], 0), filmed([sheet(12, (0.25, 0.1, 0.1))], 10)


def test_a_thing_that_moves_is_no_bump() -> None:
    before, after = moving_sheet()
    movement = picture_movement(before["cam01"], after["cam01"])
    assert movement is not None
    assert movement.pixels > 10  # which looks like a bump to each camera alone
    assert findings(before, after) == []


def test_what_no_other_camera_confirms_is_said_once() -> None:
    """Each camera sees another sheet, so that nothing tells a moving sheet from a bumped camera."""
    both = [
        {
            name: film.picture([sheet(yaw, middle, texture=20 + number)], noise=1, seed=seed + number)
            for number, (name, film) in enumerate(rig().items())
        }
        for yaw, middle, seed in ((0, (0, 0, 0), 0), (12, (0.25, 0.1, 0.1), 10))
    ]
    (found,) = findings(both[0], both[1])
    assert found.severity == "note"
    assert found.cameras == tuple(rig())
    assert found.sentence.startswith("It cannot be determined whether ")
    assert "stood still between frame 0 and frame 9: nearly all" in found.sentence


def test_bumped_cameras_of_a_room_are_named_and_no_others() -> None:
    before, after = filmed(room(), 0), filmed(room(), 10)
    after["cam02"] = np.roll(after["cam02"], (4, 9), axis=(0, 1))
    (found,) = findings(before, after)
    assert (found.severity, found.cameras) == ("error", ("cam02",))
    assert "shifted by 9.8 pixels" in found.sentence


def test_a_camera_that_was_covered_is_named() -> None:
    """Where the scene of the others stayed; a cut to another scene in all is no camera's."""
    before, after = filmed(room(), 0), filmed(room(), 10)
    (found,) = findings(before, {**after, "cam02": np.zeros_like(after["cam02"])})
    assert (found.severity, found.cameras) == ("warning", ("cam02",))
    assert (
        "Camera 'cam02' shows in frame 9 hardly anything of what it shows in frame 0: it was covered" in found.sentence
    )
    assert findings(before, filmed(room(1), 10)) == []


def test_a_bumped_camera_is_named_before_a_moving_thing() -> None:
    before, after = moving_sheet()
    found = findings(before, after | {"cam02": np.roll(after["cam02"], (9, 0), axis=(0, 1))})
    assert [each.cameras for each in found] == [("cam02",)]


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


def test_pictures_of_other_things_are_no_motion_and_bare_ones_tell_nothing() -> None:
    assert picture_movement(view(), noise_texture(9, size=SIZE)) is GONE
    assert picture_movement(view(), np.full_like(view(), 90)) is GONE
    assert picture_movement(np.full_like(view(), 90), view()) is None
