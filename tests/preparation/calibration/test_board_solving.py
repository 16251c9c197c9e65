# SPDX-License-Identifier: Apache-2.0
"""A board that is carried through a rig whose truth is known.

Cameras that saw a board, adjusted from values that are off.
"""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from structgstream.data.lenses import Fisheye, Lens, LensCamera, Pinhole, RadialTangential
from structgstream.errors import CalibrationError
from structgstream.preparation.calibration.board import Board, Sighting
from structgstream.preparation.calibration.board_solving import Sightings, adjust_board, solve_board
from structgstream.preparation.calibration.lens_terms import LensModel
from structgstream.preparation.calibration.solved import SolvedCalibration
from tests.support.calibration_errors import calibration_errors
from tests.support.filmed import Film, ring, turned
from tests.support.footage_made import BOARD, carried_board

INSTANTS = 16
LENSES: dict[LensModel, tuple[Lens, float, tuple[int, int]]] = {
    "pinhole": (Pinhole(), 300.0, (360, 270)),
    "brown": (RadialTangential(k1=0.2, k2=-0.8, p1=0.0012, p2=-0.0009, k3=0.8), 340.0, (360, 270)),
    "fisheye": (Fisheye(0.02, -0.005, 0.001), 480 / np.radians(120), (480, 360)),
}
Pictures = dict[str, list[NDArray[np.uint8]]]


@cache
def filmed(model: LensModel) -> tuple[dict[str, LensCamera], Pictures]:
    """Three cameras, and their pictures of the board near them, tilted at random."""
    lens, focal, size = LENSES[model]
    rig = ring(3, radius=1.1, arc_degrees=50, focal=focal, lens=lens, size=size)
    planes = carried_board(INSTANTS, reach=0.45, far=0.0) if model == "fisheye" else carried_board(INSTANTS)
    films = {name: Film(camera) for name, camera in rig.items()}
    return rig, {
        name: [film.picture([plane], noise=1.5, seed=index) for index, plane in enumerate(planes)]
        for name, film in films.items()
    }


@cache
def solved(model: LensModel) -> SolvedCalibration:
    return solve_board(filmed(model)[1], BOARD, lens=model)


@pytest.mark.parametrize("model", ["brown", "fisheye"])
def test_a_rig_is_found_in_metres(model: LensModel) -> None:
    """Of pinholes, with videos: test_prepare.py."""
    rig, found = filmed(model)[0], solved(model)
    assert list(found.cameras) == list(rig)
    assert found.metres
    assert found.missing == ()
    for error in calibration_errors(found.cameras, rig).values():
        # Noise of a corner is 0.1 pixels, of 16 sightings with 24; a principal point is worth a rotation.
        assert error.rotation_degrees < (0.25 if model == "fisheye" else 0.15)
        assert error.position_percent < 0.7
        assert abs(error.focal_percent) < 1
    apart = [
        float((cameras["cam00"].camera.center - cameras["cam02"].camera.center).norm())
        for cameras in (found.cameras, rig)
    ]
    assert apart[0] == pytest.approx(apart[1], rel=0.006)
    assert np.median(found.errors()) < 0.15
    np.testing.assert_array_equal(found.cameras["cam00"].camera.viewmat, np.eye(4))


def test_a_camera_that_sees_it_at_other_instants_only_is_named() -> None:
    _, pictures = filmed("pinhole")
    nothing = np.full_like(pictures["cam00"][0], 90)
    half = INSTANTS // 2
    apart = {
        "cam00": pictures["cam00"][:half] + [nothing] * half,
        "cam01": pictures["cam01"][:half] + [nothing] * half,
        "cam02": [nothing] * half + pictures["cam02"][half:],
    }
    with pytest.raises(CalibrationError, match="camera 'cam02' never show the board at an instant at which"):
        solve_board(apart, BOARD, lens="pinhole")


def test_a_board_of_another_dictionary_is_reported_by_its_name() -> None:
    pictures = {name: shots[:2] for name, shots in filmed("pinhole")[1].items()}
    with pytest.raises(CalibrationError, match="given as of DICT_6X6_100, but the pictures show markers of DICT_5X5"):
        solve_board(pictures, Board(7, 5, 0.12, dictionary="DICT_6X6_100"), lens="pinhole")


@pytest.mark.parametrize("said", [Board(5, 4, 0.12), Board(9, 5, 0.12), Board(5, 7, 0.12)])
def test_a_board_of_another_size_than_said_is_refused(said: Board) -> None:
    pictures = {name: shots[:8] for name, shots in filmed("pinhole")[1].items()}
    with pytest.raises(CalibrationError, match="give the board's real numbers"):
        solve_board(pictures, said, lens="pinhole")


RIG = ring(3, radius=1.4, arc_degrees=50, lens=RadialTangential(k1=-0.12, k2=0.02))
FIRST = next(iter(RIG.values())).camera.viewmat.numpy()


def pose(instant: int) -> NDArray[np.float64]:
    """Board to world."""
    found = np.eye(4)
    found[:3, :3] = turned(14.0 * instant - 45, axis=1) @ turned(11.0 * (instant % 5) - 22, axis=0)
    found[:3, 3] = (0.05 * instant - 0.55, 0.04 * (instant % 4) - 0.3, 0.03 * instant - 0.1)
    return found


POSES = {instant: pose(instant) for instant in (0, 1, 2, 4, 5, 6, 7)}


def sightings() -> Sightings:
    """What all cameras see of all corners; the last one misses an instant."""
    found: dict[str, list[Sighting]] = {}
    for name, filmed in RIG.items():
        for instant, board in POSES.items():
            if (name, instant) == ("cam02", 4):
                continue
            pixels = filmed.pixels(BOARD.corners @ board[:3, :3].T + board[:3, 3])
            seen = np.flatnonzero(np.isfinite(pixels).all(1))
            found.setdefault(name, []).append(Sighting(instant, seen, pixels[seen]))
    return found


def off(filmed: LensCamera) -> LensCamera:
    """A camera whose focal length is 2 % and whose place is 1 cm wrong, without distortion."""
    viewmat, K = filmed.camera.viewmat.clone(), filmed.camera.K.clone()
    viewmat[:3, 3] += torch.tensor([0.01, -0.01, 0.01], dtype=viewmat.dtype)
    K[0, 0] *= 1.02
    K[1, 1] *= 1.02
    return LensCamera(replace(filmed.camera, viewmat=viewmat, K=K), RadialTangential())


def test_without_noise_the_truth_is_found() -> None:
    start = {name: off(filmed) for name, filmed in RIG.items()}
    cameras, poses = adjust_board(BOARD, sightings(), start, POSES, lens="radial")
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
