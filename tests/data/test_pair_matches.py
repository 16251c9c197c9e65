# SPDX-License-Identifier: Apache-2.0
"""Matches of pairs of pictures, of a picture and the same one moved."""

import numpy as np
import pytest

from structgstream import cameras
from structgstream.data.matching import KEYPOINT_SIDE, Features, MatchConfig, PairMatcher
from tests.support.filmed import noise_texture

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


def test_a_pair_needs_its_number_and_share_of_inliers() -> None:
    known = pictures()
    found = len(PairMatcher(known).indices([("a", "b")])["a", "b"])
    assert len(PairMatcher(known, MatchConfig(min_inliers=found)).indices([("a", "b")])["a", "b"]) == found
    for config in (MatchConfig(min_inliers=10 * found), MatchConfig(min_inlier_share=1.01)):
        assert len(PairMatcher(known, config).indices([("a", "b")])["a", "b"]) == 0


def test_masked_pixels_have_no_keypoints() -> None:
    mask = np.ones((SIDE, SIDE), bool)
    mask[:, : SIDE // 2] = False
    matcher = PairMatcher(pictures(), masks={"a": mask})
    one, _ = matcher.matches([("a", "b")])["a", "b"]
    assert len(one)
    assert matcher.keypoints("a")[:, 0].min() >= SIDE // 2 - 1


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
        matcher = PairMatcher(images, MatchConfig(min_inlier_share=0.0))
        monkeypatch.setattr(matcher, "_extract", features.__getitem__)
        return len(matcher.indices([("a", "b")])["a", "b"])

    monkeypatch.setattr(cameras, "REFERENCE_PIXELS", SIDE)
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
