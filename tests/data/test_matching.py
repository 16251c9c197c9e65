# SPDX-License-Identifier: Apache-2.0
"""Matches of two lists of descriptors, against a search that looks at every pair alone.

Matches of pairs of pictures, of a picture and the same one moved.
"""

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from structgstream import cameras
from structgstream.data import matching
from structgstream.data.matching import (
    KEYPOINT_SIDE,
    Features,
    PairMatcher,
    back_project,
    epipolar_errors,
    fundamental_matrix,
    guided_matches,
    inside,
    mutual_matches,
    neighbor_views,
    project,
    sift_features,
    triangulate,
    unique_pairs,
    viewing_distance,
)
from tests.support.filmed import noise_texture
from tests.support.planes import distance_to_surface, room_frame, room_rig
from tests.support.rigs import arc_rig

POINTS = np.random.default_rng(0).uniform(-0.4, 0.4, (40, 3))


def test_projection_and_back_projection_are_inverse() -> None:
    camera = arc_rig()["cam02"]
    pixels, depths = project(camera, POINTS)
    np.testing.assert_allclose(back_project(camera, pixels, depths), POINTS, atol=1e-9)
    assert inside(camera, pixels, depths, near=0.1).any()
    assert not inside(camera, pixels, depths, near=100.0).any()


def test_matches_of_one_point_lie_on_each_others_epipolar_lines() -> None:
    first, second = arc_rig()["cam01"], arc_rig()["cam03"]
    a, b = project(first, POINTS)[0], project(second, POINTS)[0]
    F = fundamental_matrix(first, second)
    assert epipolar_errors(F, a, b).max() < 1e-6
    shifted = epipolar_errors(F, a, b + np.array([0.0, 3.0]))
    assert np.median(shifted) == pytest.approx(3.0, rel=0.2)


def test_two_rays_meet_where_they_came_from() -> None:
    first, second = arc_rig()["cam01"], arc_rig()["cam03"]
    points, depths = triangulate(first, second, project(first, POINTS)[0], project(second, POINTS)[0])
    np.testing.assert_allclose(points, POINTS, atol=1e-6)
    np.testing.assert_allclose(depths[:, 0], project(first, POINTS)[1], atol=1e-6)


def test_a_rig_that_looks_at_one_place_says_how_far_it_is() -> None:
    cameras = dict(arc_rig(5, radius=3.0).cameras)
    assert viewing_distance(cameras) == pytest.approx((3.0**2 + 0.3**2) ** 0.5, rel=0.05)


def test_every_pair_of_neighbours_comes_once() -> None:
    cameras = dict(arc_rig(5).cameras)
    neighbours = neighbor_views(cameras, count=2, distance=3.0)
    assert all(len(others) == 2 and name not in others for name, others in neighbours.items())
    pairs = unique_pairs(neighbours)
    assert len({frozenset(pair) for pair in pairs}) == len(pairs)


def test_keypoints_matched_along_their_lines_triangulate_onto_the_planes() -> None:
    rig = room_rig()
    frame = room_frame(rig)
    cameras = rig["cam02"], rig["cam03"]
    first, second = (sift_features(frame.images[name], count=1000) for name in ("cam02", "cam03"))
    matches = guided_matches(first, second, cameras, line_pixels=1.5, depth_range=(1.0, 6.0), ratio=0.85)
    assert len(matches) > 150
    assert len(np.unique(matches[:, 0])) == len(np.unique(matches[:, 1])) == len(matches)
    points, depths = triangulate(*cameras, first.pixels[matches[:, 0]], second.pixels[matches[:, 1]])
    assert ((depths > 1.0) & (depths < 6.0)).all()
    assert np.median(distance_to_surface(points)) < 0.02
    assert (distance_to_surface(points) < 0.1).mean() > 0.9


def test_texture_that_repeats_along_the_line_is_not_matched() -> None:
    """Two candidates with one look on one epipolar line: the ratio test drops both, unless they coincide."""
    cameras = room_rig()["cam02"], room_rig()["cam03"]
    point = np.array([[0.0, 0.1, 0.4]])
    further = back_project(cameras[0], project(cameras[0], point)[0], project(cameras[0], point)[1] * 1.3)
    look = np.zeros((1, 128), np.float32)
    look[0, 0] = 1
    query = Features(project(cameras[0], point)[0], look)
    there, apart = project(cameras[1], point)[0], project(cameras[1], further)[0]

    def matched(pixels: np.ndarray) -> int:
        candidates = Features(pixels, np.repeat(look, len(pixels), 0))
        return len(guided_matches(query, candidates, cameras, line_pixels=1.5, depth_range=(1.0, 6.0), ratio=0.85))

    assert matched(there) == 1
    assert matched(np.concatenate([there, there + 0.5])) == 1
    assert matched(np.concatenate([there, apart])) == 0


Descriptors = NDArray[np.float32]
Seen = NDArray[np.bool_]


def descriptors(count: int, *, seed: int, like: Descriptors | None = None) -> Descriptors:
    """Random unit vectors; half of them resemble those of ``like``, some more than others."""
    generator = np.random.default_rng(seed)
    found = np.abs(generator.normal(size=(count, 128)))
    if like is not None:
        noise = generator.uniform(0.02, 0.8, (count // 2, 1))
        found[: count // 2] = like[: count // 2] + noise * found[: count // 2] / 8
    return (found / np.linalg.norm(found, axis=1, keepdims=True)).astype(np.float32)


def seen_of(count: int, *, instants: int, seed: int) -> Seen:
    seen = np.random.default_rng(seed).random((count, instants)) < 0.6
    seen[~seen.any(1), 0] = True
    return seen


def searched(
    first: Descriptors, second: Descriptors, together: Seen, *, ratio: float, distance: float
) -> list[tuple[int, int]]:
    """The definition: best for each other among those that may go together, and well apart from the next best."""
    alike = np.where(together, first @ second.T, -1.0)
    found = []
    for i, row in enumerate(alike):
        j = int(row.argmax())
        next_best = np.delete(row, j).max()
        apart, further = np.sqrt(max(2 - 2 * row[j], 0)), np.sqrt(max(2 - 2 * next_best, 0))
        if alike[:, j].argmax() == i and apart < ratio * further and apart < distance:
            found.append((i, j))
    return found


@pytest.mark.parametrize("instants", [0, 3])
@pytest.mark.parametrize(("ratio", "distance"), [(0.75, math.inf), (0.95, 0.4)])
def test_matches_are_mutual_and_stand_out(
    monkeypatch: pytest.MonkeyPatch, instants: int, ratio: float, distance: float
) -> None:
    monkeypatch.setattr(matching, "BLOCK", 16)  # several blocks, the last one shorter
    first = descriptors(70, seed=1)
    second = descriptors(60, seed=2, like=first)
    seen = (seen_of(70, instants=instants, seed=3), seen_of(60, instants=instants, seed=4)) if instants else None
    together = np.ones((70, 60), bool) if seen is None else seen[0].astype(int) @ seen[1].T.astype(int) > 0
    expected = searched(first, second, together, ratio=ratio, distance=distance)
    assert 8 < len(expected) < 30  # some of the thirty alike
    found = mutual_matches(first, second, ratio=ratio, distance=distance, seen=seen)
    assert [tuple(pair) for pair in found.tolist()] == expected


def test_a_single_descriptor_has_no_next_best() -> None:
    one, many = descriptors(1, seed=1), descriptors(20, seed=2)
    assert mutual_matches(one, many, ratio=0.9).shape == (0, 2)
    assert mutual_matches(many, one, ratio=0.9).shape == (0, 2)


SIDE, SHIFT = 256, 17


def pictures() -> dict[str, np.ndarray]:
    """``b`` shows what ``a`` shows, 17 pixels further left; ``other`` something else, ``empty`` nothing."""
    wide = np.asarray(noise_texture(1, size=SIDE + SHIFT))
    return {
        "a": wide[:SIDE, :SIDE].copy(),
        "b": wide[:SIDE, SHIFT : SIDE + SHIFT].copy(),
        "other": np.asarray(noise_texture(2, size=SIDE)),
        "empty": np.full((SIDE, SIDE, 3), 90, np.uint8),
    }


def test_matches_are_where_the_same_is_seen() -> None:
    matcher = PairMatcher(pictures())
    one, two = matcher.matches([("a", "b")])["a", "b"]
    assert len(one) == len(two) >= 20
    assert np.median(np.abs(one - two - [SHIFT, 0.0])) < 0.1
    rows = matcher.indices([("a", "b")])["a", "b"]
    np.testing.assert_array_equal(matcher.keypoints("a")[rows[:, 0]], one)
    np.testing.assert_array_equal(matcher.keypoints("b")[rows[:, 1]], two)


@pytest.mark.parametrize("second", ["other", "empty"])
def test_what_is_not_the_same_has_none(second: str) -> None:
    one, two = PairMatcher(pictures()).matches([("a", second)])["a", second]
    assert one.shape == two.shape == (0, 2)


def test_a_pair_needs_its_number_and_share_of_inliers(monkeypatch: pytest.MonkeyPatch) -> None:
    known = pictures()

    def count(**limits: float) -> int:
        for name, limit in limits.items():
            monkeypatch.setattr(matching, name, limit)
        return len(PairMatcher(known).indices([("a", "b")])["a", "b"])

    found = count()
    assert count(MIN_INLIERS=found) == found
    assert count(MIN_INLIERS=10 * found) == count(MIN_INLIERS=20, MIN_INLIER_SHARE=1.01) == 0


def test_a_picture_and_a_pair_are_looked_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    matcher = PairMatcher(pictures())
    extracted: list[str] = []
    extract = matcher._extract
    monkeypatch.setattr(matcher, "_extract", lambda name: extracted.append(name) or extract(name))
    first = matcher.indices([("a", "b")])
    again = matcher.indices([("a", "b"), ("a", "other")])
    assert sorted(extracted) == ["a", "b", "other"]
    assert again["a", "b"] is first["a", "b"]
    assert list(again) == [("a", "b"), ("a", "other")]


def test_inliers_lie_as_near_in_larger_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Keypoints that are off by the same share of a picture match, however many pixels it has."""
    g = np.random.default_rng(3)

    def count(times: int) -> int:
        features = {}
        for name, shift in (("a", 0.0), ("b", SHIFT)):
            pixels = np.random.default_rng(7).uniform(20, SIDE - 20, (400, 2)) - [shift, 0.0]
            pixels += g.normal(0.0, 0.6, pixels.shape)  # 0.6 pixels of the smaller pictures
            descriptors = np.random.default_rng(8).random((400, 128)).astype(np.float32)
            features[name] = Features(times * pixels, descriptors / np.linalg.norm(descriptors, axis=1, keepdims=True))
        images = {name: np.zeros((times * SIDE, times * SIDE, 3), np.uint8) for name in features}
        matcher = PairMatcher(images)
        monkeypatch.setattr(matcher, "_extract", features.__getitem__)
        return len(matcher.indices([("a", "b")])["a", "b"])

    monkeypatch.setattr(cameras, "REFERENCE_PIXELS", SIDE)
    monkeypatch.setattr(matching, "MIN_INLIER_SHARE", 0.0)
    assert count(4) > 0.9 * count(1) > 200


def test_keypoints_of_large_pictures_are_those_of_the_reduced_one() -> None:
    """Found at ``KEYPOINT_SIDE``, in pixels of the large picture; its mask is reduced as well."""
    strip = np.tile(np.asarray(noise_texture(1, size=250))[:200], (1, KEYPOINT_SIDE // 250, 1))
    large = strip.repeat(3, axis=0).repeat(3, axis=1)
    counts = np.ones(large.shape[:2], bool)
    counts[:, : large.shape[1] // 2] = False
    matcher = PairMatcher({"a": strip, "b": large}, masks={"a": counts[::3, ::3], "b": counts})
    matcher.indices([("a", "b")])
    small, reduced = matcher.keypoints("a"), matcher.keypoints("b")
    assert len(small) > 100
    np.testing.assert_allclose(reduced, 3 * small)
    assert reduced[:, 0].min() > large.shape[1] / 2 - 3
