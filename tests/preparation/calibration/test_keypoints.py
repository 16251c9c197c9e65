# SPDX-License-Identifier: Apache-2.0
from concurrent.futures import CancelledError
from threading import Event

import numpy as np
import pytest

from structgstream.preparation.calibration import keypoints
from structgstream.preparation.calibration.keypoints import (
    all_keypoints,
    camera_keypoints,
    spread_order,
)
from tests.support.filmed import noise_texture

pytestmark = pytest.mark.finds_keypoints


def scene(shift: int) -> np.ndarray:
    """A still background with a patch that has moved by ``shift`` pixels."""
    picture = noise_texture(1, size=200).copy()
    picture[60:140, 20 + shift : 100 + shift] = noise_texture(2, size=80)
    return picture


def test_what_stands_still_is_kept_once_and_what_moves_adds() -> None:
    pictures = [scene(0), scene(0), scene(60)]
    alone = camera_keypoints(pictures[:1])
    still = camera_keypoints(pictures[:2])
    assert len(still) == len(alone)
    assert still.seen.all()
    moved = camera_keypoints(pictures)
    assert len(alone) + 20 < len(moved) < 2 * len(alone)
    beyond = moved.pixels[:, 1] > 160  # rows that the patch never covers
    assert moved.seen[beyond].mean() > 0.9
    on_patch = (np.abs(moved.pixels - (120, 100)) < 30).all(1) & moved.seen[:, 2]
    assert on_patch.sum() > 10
    assert moved.seen[on_patch, 0].mean() < 0.2  # what hardly changes in so small a patch


def test_reduced_pictures_give_pixels_of_the_whole_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(keypoints, "LONGEST_SIDE", 100)
    large = np.repeat(np.repeat(scene(0)[:100, :100], 4, 0), 4, 1)
    found = camera_keypoints([large]).pixels
    small = camera_keypoints([scene(0)[:100, :100]]).pixels
    assert len(found) == len(small)
    np.testing.assert_allclose(found, 4 * small, atol=0.1)


def test_bare_pictures_give_none() -> None:
    assert len(camera_keypoints([np.full((60, 80, 3), 90, np.uint8)] * 2)) == 0


def test_further_instants_are_looked_at_where_the_first_give_little(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(keypoints, "INSTANTS", 2)
    monkeypatch.setattr(keypoints, "ENOUGH", 1)
    pictures = {"one": [scene(shift)[40:140, :140] for shift in (0, 20, 40, 60, 80)]}
    few = all_keypoints(pictures, workers=1)["one"]
    assert few.seen.any(0).tolist() == [True, False, False, False, True]
    monkeypatch.setattr(keypoints, "ENOUGH", 10**6)
    every = all_keypoints(pictures, workers=1)["one"]
    assert every.seen.any(0).all()
    assert len(every) > len(few)


def test_every_beginning_of_the_order_is_spread() -> None:
    assert spread_order(0) == []
    assert spread_order(1) == [0]
    assert spread_order(9)[:3] == [0, 8, 4]
    assert sorted(spread_order(9)) == list(range(9))


def test_what_was_interrupted_looks_at_no_further_picture() -> None:
    stopping = Event()
    stopping.set()
    with pytest.raises(CancelledError):
        camera_keypoints([scene(0)], stopping=stopping)


def test_an_interruption_is_heard_between_two_pictures() -> None:
    looked: list[str] = []

    class Interrupting(list[np.ndarray]):
        def __getitem__(self, number: object) -> np.ndarray:  # pyright: ignore[reportIncompatibleMethodOverride]
            looked.append("one")
            raise KeyboardInterrupt

    class Slow(list[np.ndarray]):
        def __getitem__(self, number: object) -> np.ndarray:  # pyright: ignore[reportIncompatibleMethodOverride]
            looked.append("two")
            return scene(0)

    pictures = {"one": Interrupting([scene(0)] * 3), "two": Slow([scene(0)] * 3)}
    with pytest.raises(KeyboardInterrupt):
        all_keypoints(pictures, workers=2)
    assert looked.count("one") == 1
    assert looked.count("two") < 3
