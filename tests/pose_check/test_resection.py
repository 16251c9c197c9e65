# SPDX-License-Identifier: Apache-2.0
"""A camera's points under a known mistake: what is stated is what was made."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from structgstream.cameras import Camera
from structgstream.data.matching import project
from structgstream.pose_check.tracks import Tracks
from structgstream.pose_check.verdicts import Resection, explained, resect
from tests.support.evidence_made import shifted, turned
from tests.support.rigs import look_at

NOISE = 0.3  # pixels


def true_camera() -> Camera:
    K = torch.tensor([[600.0, 0, 322], [0, 602, 239], [0, 0, 1]], dtype=torch.float64)
    eye, target = (torch.tensor(place, dtype=torch.float64) for place in ([0.3, -0.2, -3.0], [0.0, 0.0, 0.0]))
    return Camera(look_at(eye, target), K, 640, 480)


def observed(count: int = 120, *, wrong: float = 0.0, seed: int = 0) -> Tracks:
    """Points of a room as the true camera sees them, a share of them matched wrongly."""
    generator = np.random.default_rng(seed)
    points = generator.uniform([-0.8, -0.6, -0.8], [0.8, 0.6, 0.8], (count, 3))
    pixels = project(true_camera(), points)[0] + generator.normal(0, NOISE, (count, 2))
    lost = generator.random(count) < wrong
    pixels[lost] = generator.uniform([0, 0], [640, 480], (lost.sum(), 2))
    every = np.arange(count)
    return Tracks(("cam",), points, every, np.zeros(count, np.intp), pixels, np.zeros(count))


def of(given: Camera, tracks: Tracks) -> Resection:
    found = resect(tracks, given, "cam")
    assert found is not None
    return found


@pytest.mark.parametrize("wrong", [0.0, 0.3])
@pytest.mark.parametrize("degrees", [0.3, 1.0, 25.0])
def test_a_turn_is_stated(degrees: float, wrong: float) -> None:
    found = of(turned(true_camera(), degrees), observed(wrong=wrong))
    assert found.better
    assert found.degrees == pytest.approx(degrees, abs=max(3 * found.degrees_error, 0.02))
    assert found.degrees_error < 0.05
    assert (found.share_of_distance, found.focal_percent) == (0, 0)
    assert found.description.startswith(f"place it {found.degrees:.2f} degrees")


def test_a_move_is_stated() -> None:
    found = of(shifted(true_camera(), (0.0, 0.06, 0.0)), observed())
    assert found.better
    assert found.share_of_distance == pytest.approx(0.02, abs=0.003)
    assert found.degrees == 0
    assert "of its distance to the scene" in found.description


@pytest.mark.parametrize("factor", [1.02, 0.95])
def test_a_focal_length_is_stated(factor: float) -> None:
    camera = true_camera()
    K = camera.K.clone()
    K[0, 0], K[1, 1] = K[0, 0] * factor, K[1, 1] * factor
    found = of(replace(camera, K=K), observed())
    assert found.better
    assert found.focal_percent == pytest.approx(100 * (1 / factor - 1), abs=0.2)
    assert (found.degrees, found.share_of_distance) == (0, 0)
    assert ("shorter" if factor > 1 else "longer") in found.description


def test_a_good_camera_is_as_given() -> None:
    found = of(true_camera(), observed())
    assert found.as_given
    assert not found.better


@pytest.mark.parametrize(("count", "wrong"), [(120, 0.5), (16, 0.5)])
def test_wrong_matches_do_not_condemn(count: int, wrong: float) -> None:
    for seed in range(5):
        found = resect(observed(count, wrong=wrong, seed=seed), true_camera(), "cam")
        assert found is not None
        assert not found.better


def test_what_no_camera_explains_is_not_better() -> None:
    found = resect(observed(wrong=1.0), true_camera(), "cam")
    assert found is None or not (found.better or found.as_given)


def test_too_few_points_say_nothing() -> None:
    assert resect(observed(5), true_camera(), "cam") is None
    assert resect(observed(), true_camera(), "other") is None


def test_points_that_a_camera_explains_are_counted() -> None:
    tracks = observed(100, wrong=0.25, seed=3)
    assert 70 <= explained(tracks, true_camera(), "cam") <= 85
    assert explained(tracks, turned(true_camera(), 5), "cam") < 5
