# SPDX-License-Identifier: Apache-2.0
"""Matches of two lists of descriptors, against a search that looks at every pair alone."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from structgstream.data import matching as descriptor_matches
from structgstream.data.matching import mutual_matches

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
    monkeypatch.setattr(descriptor_matches, "BLOCK", 16)  # several blocks, the last one shorter
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
