# SPDX-License-Identifier: Apache-2.0
"""Cameras that saw a board, adjusted from values that are off."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from structgstream.data.lenses import LensCamera, RadialTangential
from structgstream.preparation.calibration.board import Board, Sighting
from structgstream.preparation.calibration.board_solving import Sightings, adjust_board
from tests.support.calibration_errors import calibration_errors
from tests.support.filmed import ring, turned

BOARD = Board(7, 5, 0.12)
RIG = ring(3, radius=1.4, arc_degrees=50, lens=RadialTangential(k1=-0.12, k2=0.02))
FIRST = next(iter(RIG.values())).camera.viewmat.numpy()


def pose(instant: int) -> NDArray[np.float64]:
    """Board to world."""
    found = np.eye(4)
    found[:3, :3] = turned(14.0 * instant - 45, axis=1) @ turned(11.0 * (instant % 5) - 22, axis=0)
    found[:3, 3] = (0.05 * instant - 0.55, 0.04 * (instant % 4) - 0.3, 0.03 * instant - 0.1)
    return found


POSES = {instant: pose(instant) for instant in (0, 1, 2, 4, 5, 6, 7)}


def sightings(*, noise: float = 0.0) -> Sightings:
    """What all cameras see of all corners; the last one misses an instant."""
    generator = np.random.default_rng(0)
    found: dict[str, list[Sighting]] = {}
    for name, filmed in RIG.items():
        for instant, board in POSES.items():
            if (name, instant) == ("cam02", 4):
                continue
            pixels = filmed.pixels(BOARD.corners @ board[:3, :3].T + board[:3, 3])
            seen = np.flatnonzero(np.isfinite(pixels).all(1))
            pixels = pixels[seen] + noise * generator.normal(size=(len(seen), 2))
            found.setdefault(name, []).append(Sighting(instant, seen, pixels))
    return found


def off(filmed: LensCamera) -> LensCamera:
    """A camera whose focal length is 2 % and whose place is 1 cm wrong, without distortion."""
    viewmat, K = filmed.camera.viewmat.clone(), filmed.camera.K.clone()
    viewmat[:3, 3] += torch.tensor([0.01, -0.01, 0.01], dtype=viewmat.dtype)
    K[0, 0] *= 1.02
    K[1, 1] *= 1.02
    return LensCamera(replace(filmed.camera, viewmat=viewmat, K=K), RadialTangential())


def adjusted(*, noise: float = 0.0) -> tuple[dict[str, LensCamera], dict]:
    start = {name: off(filmed) for name, filmed in RIG.items()}
    return adjust_board(BOARD, sightings(noise=noise), start, POSES, lens="radial")


def test_without_noise_the_truth_is_found() -> None:
    cameras, poses = adjusted()
    for error in calibration_errors(cameras, RIG).values():
        assert error.rotation_degrees < 1e-3
        assert error.position_percent < 1e-3
    for name, filmed in cameras.items():
        assert float(filmed.camera.K[0, 0]) == pytest.approx(float(RIG[name].camera.K[0, 0]), rel=1e-5)
        assert isinstance(filmed.lens, RadialTangential)
        assert filmed.lens.k1 == pytest.approx(-0.12, abs=1e-4)
    assert list(poses) == list(POSES)
    for instant, found in poses.items():
        np.testing.assert_allclose(found, FIRST @ POSES[instant], atol=1e-5)


def test_the_first_camera_is_the_world_exactly() -> None:
    cameras, _ = adjusted(noise=0.3)
    assert (cameras["cam00"].camera.viewmat == torch.eye(4, dtype=torch.float64)).all()


def test_noise_makes_small_errors() -> None:
    cameras, _ = adjusted(noise=0.3)
    for error in calibration_errors(cameras, RIG).values():
        assert error.rotation_degrees < 0.2
        assert error.position_percent < 1.0
