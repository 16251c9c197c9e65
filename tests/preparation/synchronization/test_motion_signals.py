# SPDX-License-Identifier: Apache-2.0
"""Changes of pictures."""

import numpy as np
import pytest

from structgstream.preparation.synchronization.motion import (
    BUNDLES,
    CalibratedGeometry,
    Changes,
    PairGeometry,
    line_signals,
    picture_changes,
)
from tests.support.takes import HEIGHT, WIDTH, lenses, ring

STAMPS = np.array([0.0, 0.1, 0.25, 0.3])


def pictures(*, square: bool = True, noise: float = 2.0) -> list[np.ndarray]:
    """Grey with noise, and a bright square that jumps to the right at the third picture."""
    generator = np.random.default_rng(0)
    made = []
    for index in range(4):
        picture = generator.normal(100, noise, (120, 200, 3))
        if square:
            left = 40 if index < 2 else 120
            picture[50:80, left : left + 30] += 80
        made.append(np.clip(picture, 0, 255).astype(np.uint8))
    return made


def test_changes_are_where_and_when_something_moves() -> None:
    changes = picture_changes(pictures(), STAMPS)
    assert changes.amounts.shape == (3, 96, 160)
    assert np.allclose(changes.times, [0.05, 0.175, 0.275])
    assert changes.activity.argmax() == 1
    assert changes.moving
    jump = changes.amounts[1]
    assert jump[52, 44] > 40  # the middle of where it was, in reduced pixels
    assert jump[52, 108] > 40
    assert jump[:30].max() < 10


def test_noise_is_no_motion() -> None:
    for noise in (0.0, 2.0, 8.0):
        assert not picture_changes(pictures(square=False, noise=noise), STAMPS).moving


def test_one_picture_has_no_changes() -> None:
    changes = picture_changes(pictures()[:1], STAMPS)
    assert len(changes.times) == 0
    assert not changes.moving


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
