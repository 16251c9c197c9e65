# SPDX-License-Identifier: Apache-2.0
"""Bundles of corresponding epipolar lines."""

import numpy as np
import pytest

from structgstream.preparation.synchronization.motion_signals import (
    BUNDLES,
    CalibratedGeometry,
    Changes,
    PairGeometry,
    line_signals,
)
from tests.support.takes import HEIGHT, WIDTH, lenses, ring

CAMERAS = lenses(ring(3))


def spots(name: str, points: np.ndarray) -> Changes:
    """Changes of one pixel a frame: where each point ``[T, 3]`` is seen."""
    amounts = np.zeros((len(points), HEIGHT, WIDTH), np.uint8)
    pixels = CAMERAS[name].pixels(points)
    for frame, (x, y) in enumerate(pixels):
        amounts[frame, int(y), int(x)] = 100
    return Changes(amounts, np.arange(len(points)) / 30, (WIDTH, HEIGHT))


@pytest.mark.parametrize("pair", [("cam0", "cam1"), ("cam1", "cam2"), ("cam0", "cam2")])
def test_a_point_is_in_the_same_bundle_of_both_views(pair: tuple[str, str]) -> None:
    """Up to the next one, because a pixel has a size; whatever the depth."""
    points = np.random.default_rng(0).uniform(-0.6, 0.6, (200, 3))
    geometry = CalibratedGeometry(CAMERAS).pair(*pair)
    assert geometry is not None
    signals = line_signals(spots(pair[0], points), spots(pair[1], points), geometry)
    assert signals is not None
    seen = (signals[0].sum(1) > 0) & (signals[1].sum(1) > 0)
    assert seen.mean() > 0.9
    apart = np.abs(signals[0].argmax(1) - signals[1].argmax(1))[seen]
    assert np.minimum(apart, BUNDLES - apart).max() <= 1


def test_a_scaled_fundamental_matrix_is_the_same() -> None:
    points = np.random.default_rng(1).uniform(-0.5, 0.5, (20, 3))
    geometry = CalibratedGeometry(CAMERAS).pair("cam0", "cam1")
    assert geometry is not None
    scaled = PairGeometry(-7.5 * geometry.F, geometry.straighten)
    views = spots("cam0", points), spots("cam1", points)
    first, second = line_signals(*views, geometry), line_signals(*views, scaled)
    assert first is not None
    assert second is not None
    assert np.allclose(first[0], second[0])
    assert np.allclose(first[1], second[1])


def test_views_that_share_few_lines_have_no_signals() -> None:
    """The second picture is far above the first one, on rows that no line of the first meets."""
    F = np.array([[0.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # the same rows
    views = spots("cam0", np.zeros((3, 3))), spots("cam1", np.zeros((3, 3)))
    geometry = PairGeometry(F, (lambda pixels: pixels, lambda pixels: pixels + np.array([0.0, 0.9 * HEIGHT])))
    assert line_signals(*views, PairGeometry(F, (lambda pixels: pixels, lambda pixels: pixels))) is not None
    assert line_signals(*views, geometry) is None
