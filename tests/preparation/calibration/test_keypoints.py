# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest
import torch

from structgstream.data.lenses import Fisheye, LensCamera, RadialTangential
from structgstream.preparation.calibration import keypoints
from structgstream.preparation.calibration.keypoints import (
    Keypoints,
    agreeing_matches,
    all_keypoints,
    all_matches,
    camera_rays,
    epipolar_angles,
    epipolar_pixels,
    guided_matches,
    keypoint_matches,
    spread_order,
)
from tests.support import repetitive
from tests.support.filmed import noise_texture, ring
from tests.support.repetitive import POINTS
from tests.support.views_made import cloud, keypoints_of, matches_of

pytestmark = pytest.mark.finds_keypoints


def scene(shift: int) -> np.ndarray:
    """A still background with a patch that has moved by ``shift`` pixels."""
    picture = noise_texture(1, size=200).copy()
    picture[60:140, 20 + shift : 100 + shift] = noise_texture(2, size=80)
    return picture


def of_camera(pictures: list[np.ndarray]) -> Keypoints:
    return all_keypoints({"one": pictures})["one"]


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
    few = all_keypoints(pictures)["one"]
    assert few.seen.any(0).tolist() == [True, False, False, False, True]
    monkeypatch.setattr(keypoints, "ENOUGH", 10**6)
    every = all_keypoints(pictures)["one"]
    assert every.seen.any(0).all()
    assert len(every) > len(few)


def test_every_beginning_of_the_order_is_spread() -> None:
    assert spread_order(0) == []
    assert spread_order(1) == [0]
    assert spread_order(9)[:3] == [0, 8, 4]
    assert sorted(spread_order(9)) == list(range(9))


def test_an_interruption_is_heard_between_two_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(keypoints, "WORKERS", 2)
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
        all_keypoints(pictures)
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
    found = all_matches(cameras)
    assert {pair: matches.tolist() for pair, matches in found.items()} == {
        ("a", "b"): [[2, 0]],
        ("a", "c"): [[0, 2]],
        ("b", "c"): [[1, 0]],
    }


def test_what_looks_alike_is_distinguished_by_epipolar_lines() -> None:
    cameras = repetitive.ring()
    keypoints = repetitive.keypoints_of(cameras)
    alone = all_matches(keypoints)
    guided = guided_matches(keypoints, cameras, pixels=2.0)
    pair = ("cam0", "cam1")
    assert len(alone[pair]) < 0.1 * POINTS
    assert len(guided[pair]) > 0.5 * POINTS
    right = guided[pair][:, 0] == guided[pair][:, 1]
    assert right.mean() > 0.95


def test_matches_share_an_instant() -> None:
    cameras = {name: filmed for name, filmed in repetitive.ring().items() if name in ("cam0", "cam1")}
    keypoints = repetitive.keypoints_of(cameras)
    early = np.stack([np.arange(POINTS) % 2 == 0, np.arange(POINTS) % 2 == 1], 1)
    both = {
        "cam0": replace(keypoints["cam0"], seen=early),
        "cam1": replace(keypoints["cam1"], seen=early[:, ::-1]),
    }
    found = guided_matches(both, cameras, pixels=2.0)["cam0", "cam1"]
    assert not (found[:, 0] == found[:, 1]).any()


def test_cameras_that_look_apart_are_not_matched(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(keypoints, "FACING_DEGREES", 20.0)
    cameras = repetitive.ring()
    found = guided_matches(repetitive.keypoints_of(cameras), cameras, pixels=2.0)
    assert ("cam0", "cam1") in found
    assert ("cam0", "cam5") not in found


def test_cameras_of_one_place_have_no_planes() -> None:
    camera = repetitive.ring()["cam0"]
    both = {"one": camera, "two": camera}
    assert len(guided_matches(repetitive.keypoints_of(both), both, pixels=2.0)["one", "two"]) == 0


def test_no_keypoints_give_no_matches() -> None:
    cameras = {name: filmed for name, filmed in repetitive.ring().items() if name in ("cam0", "cam1")}
    keypoints = repetitive.keypoints_of(cameras)
    own = keypoints["cam1"]
    none = replace(own, pixels=own.pixels[:0], descriptors=own.descriptors[:0], seen=own.seen[:0])
    assert len(guided_matches(keypoints | {"cam1": none}, cameras, pixels=2.0)["cam0", "cam1"]) == 0


LENS = RadialTangential(k1=-0.12, k2=0.02, p1=0.001)
RIG = ring(3, radius=2.6, arc_degrees=40, lens=LENS)
WORLD = cloud(80)


@pytest.mark.parametrize("lens", [LENS, Fisheye(0.02, -0.005)])
def test_rays_point_to_what_was_seen(lens: RadialTangential | Fisheye) -> None:
    for filmed in ring(2, radius=2.6, arc_degrees=40, lens=lens).values():
        towards = WORLD - filmed.camera.center.numpy()
        found = camera_rays(filmed, filmed.pixels(WORLD))
        np.testing.assert_allclose(found, towards / np.linalg.norm(towards, axis=1, keepdims=True), atol=1e-7)


def two(x: float = 1.0) -> tuple[LensCamera, LensCamera]:
    """The first camera, and it again, moved along the world's x axis."""
    one = RIG["cam00"]
    viewmat = one.camera.viewmat.clone()
    viewmat[:3, 3] -= viewmat[:3, :3] @ torch.tensor([x, 0.0, 0.0], dtype=torch.float64)
    moved = type(one.camera)(viewmat, one.camera.K, one.camera.width, one.camera.height)
    return one, LensCamera(moved, one.lens)


def unit(*vector: float) -> np.ndarray:
    return np.array([vector]) / np.linalg.norm(vector)


@pytest.mark.parametrize(
    ("second", "degrees"),
    [
        ((-0.4, 0.0, 1.0), 0.0),  # meets the first ray ahead
        ((-0.4, 0.035, 1.0), 2.005),  # two degrees above the plane, in the plane through the base
        ((0.4, 0.0, 1.0), 90.0),  # parts from it, so they meet behind
        ((0.0, 0.0, 1.0), 0.0),  # parallel: meets it at infinity
    ],
)
def test_angles_to_the_epipolar_plane(second: tuple[float, float, float], degrees: float) -> None:
    """The base is the x axis and the first ray the z axis: the plane is y = 0."""
    found = epipolar_angles(two(), (unit(0, 0, 1), unit(*second)))
    assert np.degrees(found[0]) == pytest.approx(degrees, abs=1e-3)


def test_cameras_of_one_place_agree_where_rays_are_the_same() -> None:
    found = epipolar_angles(two(0.0), (unit(0, 0, 1), unit(0, np.sin(0.1), np.cos(0.1))))
    assert found[0] == pytest.approx(0.1)


def test_matches_off_their_plane_go() -> None:
    """Half of the keypoints of a camera are moved across their epipolar lines by two pixels of 420: 0.27 degrees."""
    rig = ring(2, radius=2.6, arc_degrees=40)
    keypoints, matches = keypoints_of(rig, WORLD), matches_of(rig, WORLD)
    keypoints["cam01"].pixels[::2, 1] += 2.0
    near = agreeing_matches(keypoints, matches, rig, degrees=0.1)["cam00", "cam01"]
    kept = matches["cam00", "cam01"]
    assert near.tolist() == kept[kept[:, 0] % 2 == 1].tolist()
    far = epipolar_pixels(keypoints, matches, rig)["cam00", "cam01"]
    assert far[kept[:, 0] % 2 == 1].max() < 1e-3
    # Lines are not quite rows, and rays beside the axis are longer than the focal length.
    assert np.median(far[kept[:, 0] % 2 == 0]) == pytest.approx(2.0, abs=0.25)
