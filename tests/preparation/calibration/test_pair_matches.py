# SPDX-License-Identifier: Apache-2.0
"""Matches of two lists of keypoints, against a search that looks at every pair alone."""

import numpy as np
import pytest

from structgstream.preparation.calibration import pair_matches
from structgstream.preparation.calibration.keypoints import Keypoints
from structgstream.preparation.calibration.pair_matches import MatchConfig, mutual_matches


def keypoints(count: int, *, seed: int, instants: int = 1, like: Keypoints | None = None) -> Keypoints:
    """Random keypoints; half of them resemble those of ``like``."""
    generator = np.random.default_rng(seed)
    descriptors = generator.normal(size=(count, 128))
    if like is not None:
        descriptors[: count // 2] = like.descriptors[: count // 2] + 0.02 * generator.normal(size=(count // 2, 128))
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
    seen = generator.random((count, instants)) < 0.7
    seen[~seen.any(1), 0] = True
    pixels = generator.uniform(0, 100, (count, 2))
    return Keypoints(pixels, descriptors.astype(np.float32), seen)


def searched(first: Keypoints, second: Keypoints, config: MatchConfig) -> list[tuple[int, int]]:
    """The definition: best for each other among those of a common instant, and well apart from the next best."""
    together = (first.seen[:, None] & second.seen[None]).any(-1)
    alike = np.where(together, first.descriptors @ second.descriptors.T, -1.0)
    found = []
    for i, row in enumerate(alike):
        j = int(row.argmax())
        next_best = np.delete(row, j).max()
        apart, further = np.sqrt(max(2 - 2 * row[j], 0)), np.sqrt(max(2 - 2 * next_best, 0))
        if alike[:, j].argmax() == i and apart < config.ratio * further and apart < config.distance:
            found.append((i, j))
    return found


@pytest.mark.parametrize("instants", [1, 3])
def test_matches_are_mutual_and_stand_out(monkeypatch: pytest.MonkeyPatch, instants: int) -> None:
    monkeypatch.setattr(pair_matches, "BLOCK", 16)  # several blocks, the last one shorter
    first = keypoints(70, seed=1, instants=instants)
    second = keypoints(60, seed=2, instants=instants, like=first)
    config = MatchConfig()
    expected = searched(first, second, config)
    assert len(expected) > 10
    assert [tuple(pair) for pair in mutual_matches(first, second, config=config).tolist()] == expected


def test_a_single_keypoint_has_no_next_best() -> None:
    assert mutual_matches(keypoints(1, seed=1), keypoints(20, seed=2)).shape == (0, 2)
