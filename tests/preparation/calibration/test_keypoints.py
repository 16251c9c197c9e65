# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest

from structgstream.preparation.calibration import keypoints
from structgstream.preparation.calibration.keypoints import (
    Keypoints,
    all_keypoints,
    all_matches,
    guided_matches,
    keypoint_matches,
    spread_order,
)
from tests.support.filmed import noise_texture
from tests.support.repetitive import POINTS, keypoints_of, ring

pytestmark = pytest.mark.finds_keypoints


def scene(shift: int) -> np.ndarray:
    """A still background with a patch that has moved by ``shift`` pixels."""
    picture = noise_texture(1, size=200).copy()
    picture[60:140, 20 + shift : 100 + shift] = noise_texture(2, size=80)
    return picture


def of_camera(pictures: list[np.ndarray]) -> Keypoints:
    return all_keypoints({"one": pictures}, workers=1)["one"]


def test_what_stands_still_is_kept_once_and_what_moves_adds() -> None:
    pictures = [scene(0), scene(0), scene(60)]
    alone = of_camera(pictures[:1])
    still = of_camera(pictures[:2])
    assert len(still) == len(alone)
    assert still.seen.all()
    moved = of_camera(pictures)
    assert len(alone) + 20 < len(moved) < 2 * len(alone)
    beyond = moved.pixels[:, 1] > 160  # rows that the patch never covers
    assert moved.seen[beyond].mean() > 0.9
    on_patch = (np.abs(moved.pixels - (120, 100)) < 30).all(1) & moved.seen[:, 2]
    assert on_patch.sum() > 10
    assert moved.seen[on_patch, 0].mean() < 0.2  # what hardly changes in so small a patch


def test_reduced_pictures_give_pixels_of_the_whole_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(keypoints, "LONGEST_SIDE", 100)
    large = np.repeat(np.repeat(scene(0)[:100, :100], 4, 0), 4, 1)
    found = of_camera([large]).pixels
    small = of_camera([scene(0)[:100, :100]]).pixels
    assert len(found) == len(small)
    np.testing.assert_allclose(found, 4 * small, atol=0.1)


def test_bare_pictures_give_none() -> None:
    assert len(of_camera([np.full((60, 80, 3), 90, np.uint8)] * 2)) == 0


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


def made(looks: list[int], seen: list[list[int]]) -> Keypoints:
    descriptors = np.zeros((len(looks), 128), np.float32)
    descriptors[np.arange(len(looks)), looks] = 1
    return Keypoints(np.zeros((len(looks), 2)), descriptors, np.array(seen, bool))


def test_keypoints_match_only_within_an_instant() -> None:
    first = made([0, 1, 2], [[1, 0], [1, 1], [0, 1]])
    second = made([0, 1, 2], [[0, 1], [0, 1], [0, 1]])
    assert keypoint_matches(first, second).tolist() == [[1, 1], [2, 2]]


def test_a_rival_at_another_instant_does_not_count() -> None:
    first = made([0, 5], [[1, 0], [1, 0]])
    assert keypoint_matches(first, made([0, 0, 7], [[1, 0], [0, 1], [1, 1]])).tolist() == [[0, 0]]
    assert keypoint_matches(first, made([0, 0, 7], [[1, 0], [1, 1], [1, 1]])).tolist() == []


def test_descriptors_that_are_far_apart_do_not_match() -> None:
    """The nearest of a keypoint may stand out and still be of something else."""
    first, second = made([0, 1], [[1], [1]]), made([0, 2], [[1], [1]])
    assert keypoint_matches(first, second).tolist() == [[0, 0]]
    turned = np.float32(0.75)  # its cosine with the first axis: a distance of 0.71, and of 0.84 when it is 0.65
    for cosine, matched in ((turned, [[0, 0]]), (np.float32(0.65), [])):
        second.descriptors[0, [0, 3]] = cosine, np.sqrt(1 - cosine**2)
        assert keypoint_matches(first, second).tolist() == matched


def test_every_pair_of_cameras_is_matched() -> None:
    cameras = {name: made(looks, [[1]] * 3) for name, looks in {"a": [0, 1, 2], "b": [2, 3, 4], "c": [3, 5, 0]}.items()}
    found = all_matches(cameras, workers=2)
    assert {pair: matches.tolist() for pair, matches in found.items()} == {
        ("a", "b"): [[2, 0]],
        ("a", "c"): [[0, 2]],
        ("b", "c"): [[1, 0]],
    }


def test_what_looks_alike_is_distinguished_by_epipolar_lines() -> None:
    cameras = ring()
    keypoints = keypoints_of(cameras)
    alone = all_matches(keypoints, workers=1)
    guided = guided_matches(keypoints, cameras, pixels=2.0, workers=1)
    pair = ("cam0", "cam1")
    assert len(alone[pair]) < 0.1 * POINTS
    assert len(guided[pair]) > 0.5 * POINTS
    right = guided[pair][:, 0] == guided[pair][:, 1]
    assert right.mean() > 0.95


def test_matches_share_an_instant() -> None:
    cameras = {name: filmed for name, filmed in ring().items() if name in ("cam0", "cam1")}
    keypoints = keypoints_of(cameras)
    early = np.stack([np.arange(POINTS) % 2 == 0, np.arange(POINTS) % 2 == 1], 1)
    both = {
        "cam0": replace(keypoints["cam0"], seen=early),
        "cam1": replace(keypoints["cam1"], seen=early[:, ::-1]),
    }
    found = guided_matches(both, cameras, pixels=2.0, workers=1)["cam0", "cam1"]
    assert not (found[:, 0] == found[:, 1]).any()


def test_cameras_that_look_apart_are_not_matched(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(keypoints, "FACING_DEGREES", 20.0)
    cameras = ring()
    found = guided_matches(keypoints_of(cameras), cameras, pixels=2.0, workers=1)
    assert ("cam0", "cam1") in found
    assert ("cam0", "cam5") not in found


def test_cameras_of_one_place_have_no_planes() -> None:
    camera = ring()["cam0"]
    both = {"one": camera, "two": camera}
    assert len(guided_matches(keypoints_of(both), both, pixels=2.0, workers=1)["one", "two"]) == 0


def test_no_keypoints_give_no_matches() -> None:
    cameras = {name: filmed for name, filmed in ring().items() if name in ("cam0", "cam1")}
    keypoints = keypoints_of(cameras)
    own = keypoints["cam1"]
    none = replace(own, pixels=own.pixels[:0], descriptors=own.descriptors[:0], seen=own.seen[:0])
    assert len(guided_matches(keypoints | {"cam1": none}, cameras, pixels=2.0, workers=1)["cam0", "cam1"]) == 0
