# SPDX-License-Identifier: Apache-2.0
import numpy as np

from structgstream.preparation.calibration.keypoints import Keypoints, all_matches, keypoint_matches


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
