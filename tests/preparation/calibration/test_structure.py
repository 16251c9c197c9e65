# SPDX-License-Identifier: Apache-2.0
"""Structure from motion of a room whose truth is known."""

import logging
from dataclasses import replace
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from structgstream.data.lenses import RadialTangential
from structgstream.errors import CalibrationError
from structgstream.preparation.calibration import structure
from structgstream.preparation.calibration.keypoints import Keypoints, all_keypoints
from structgstream.preparation.calibration.solved import SolvedCalibration
from structgstream.preparation.calibration.structure import solve_structure
from tests.support.calibration_errors import calibration_errors
from tests.support.filmed import filmed_room, noise_texture


def noise(seed: int) -> NDArray[np.uint8]:
    return noise_texture(seed, size=320)[:240]


@cache
def solved() -> SolvedCalibration:
    return solve_structure(filmed_room()[1], lens="radial")


def test_a_rig_is_found_from_its_pictures() -> None:
    rig, found = filmed_room()[0], solved()
    assert found.missing == ()
    assert list(found.cameras) == list(rig)
    assert not found.metres
    assert len(found.points) > 300
    assert np.median(found.errors()) < 0.3
    # At 320 x 240 and with 20 keypoints to a hundred pixels; half a percent of the focal length is a pixel at the edge.
    for error in calibration_errors(found.cameras, rig).values():
        assert error.rotation_degrees < 0.3  # principal points are free, and worth a rotation
        assert error.position_percent < 1
        assert abs(error.focal_percent) < 1.5
        assert error.lens_pixels < 1.5


def test_principal_points_that_all_cameras_have_off_the_middle_are_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is cut off at the right and at the bottom moves the middle by 4 and 3 pixels, and no keypoint."""
    rig, pictures = filmed_room()
    cut = {name: [np.ascontiguousarray(shots[0][:-6, :-8])] for name, shots in pictures.items()}
    found = {}
    for name, own in all_keypoints(pictures, workers=1).items():
        left = (own.pixels < (312, 234)).all(1)
        found[name] = Keypoints(own.pixels[left], own.descriptors[left], own.seen[left])
    monkeypatch.setattr(structure, "all_keypoints", lambda pictures, **options: found)
    solved = solve_structure(cut, lens="radial")
    errors = calibration_errors(solved.cameras, rig).values()
    assert np.median([error.rotation_degrees for error in errors]) < 0.2  # half as much as the middle is off
    assert max(error.rotation_degrees for error in errors) < 0.3


def test_shared_intrinsics_are_one() -> None:
    rig, pictures = filmed_room()
    found = solve_structure(pictures, lens="radial", intrinsics="shared")
    first = found.cameras["cam00"]
    for name, error in calibration_errors(found.cameras, rig).items():
        assert error.rotation_degrees < 0.15
        assert found.cameras[name].lens == first.lens
        np.testing.assert_array_equal(found.cameras[name].camera.K, first.camera.K)


def test_the_same_pictures_give_the_same_numbers() -> None:
    one, two = solved(), solve_structure(filmed_room()[1], lens="radial")
    np.testing.assert_array_equal(one.points, two.points)
    for name in one.cameras:
        np.testing.assert_array_equal(one.cameras[name].camera.viewmat, two.cameras[name].camera.viewmat)


def test_a_camera_that_looks_elsewhere_is_named(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(structure, "FIELDS_OF_VIEW", {"radial": (60.0,)})
    pictures = {name: filmed_room()[1][name] for name in ("cam01", "cam02", "cam03")}
    with caplog.at_level(logging.WARNING):
        found = solve_structure(pictures | {"alone": [noise(99)[:120, :160]]}, lens="radial")
    assert found.missing == ("alone",)
    assert "alone" not in found.cameras
    assert "camera 'alone' could not be placed: 'alone' (0 of " in caplog.text
    assert "film a board" in caplog.text


def test_cameras_that_see_nothing_in_common_are_refused() -> None:
    with pytest.raises(CalibrationError, match="anything in common: cameras 'cam0', 'cam1', 'cam2' have no pair"):
        solve_structure({f"cam{index}": [noise(index)[:120, :160]] for index in range(3)})


def test_two_cameras_are_refused() -> None:
    _, pictures = filmed_room()
    with pytest.raises(CalibrationError, match="three cameras or more, got cameras 'cam00', 'cam01'"):
        solve_structure({name: pictures[name] for name in ("cam00", "cam01")})


def test_shared_intrinsics_of_two_sizes_are_refused() -> None:
    _, pictures = filmed_room()
    smaller = pictures | {"cam04": [np.ascontiguousarray(pictures["cam04"][0][::2, ::2])]}
    with pytest.raises(CalibrationError, match="Shared intrinsics need pictures of one size"):
        solve_structure(smaller, intrinsics="shared")


def test_observations_are_of_the_pictures_as_filmed() -> None:
    found = solved()
    straight = {name: replace(one, lens=RadialTangential()) for name, one in found.cameras.items()}
    assert np.nanmedian(replace(found, cameras=straight).errors()) > 2 * np.nanmedian(found.errors())


def test_focal_lengths_that_files_state_are_tried_first(monkeypatch: pytest.MonkeyPatch) -> None:
    """One camera states nothing."""
    starts: list[dict[str, float]] = []

    def noted(*arguments: Any, **options: Any) -> Any:
        starts.append({name: camera.mean_focal_length() for name, camera in arguments[2].items()})
        raise StopIteration

    monkeypatch.setattr(structure, "_attempt", noted)
    pictures = {name: filmed_room()[1][name] for name in ("cam00", "cam01", "cam02", "cam03")}
    with pytest.raises(StopIteration):
        solve_structure(pictures, lens="pinhole", focals={"cam00": 980.0, "cam01": 1010.0, "cam03": 990.0})
    assert starts == [pytest.approx({"cam00": 980.0, "cam01": 1010.0, "cam02": 990.0, "cam03": 990.0}, rel=1e-3)]


def test_the_start_that_places_most_cameras_wins(monkeypatch: pytest.MonkeyPatch) -> None:
    attempts = [SimpleNamespace(model=size, size=size, pairs={}) for size in ((2, 900), (3, 500), (3, 400))]
    left, taken = iter(attempts), []

    def finished(best: SimpleNamespace, *arguments: Any, **options: Any) -> SimpleNamespace:
        taken.append(best)
        return SimpleNamespace(missing=())

    monkeypatch.setattr(structure, "FIELDS_OF_VIEW", {"pinhole": (40.0, 60.0, 80.0)})
    monkeypatch.setattr(structure, "all_keypoints", lambda *arguments, **options: {})
    monkeypatch.setattr(structure, "all_matches", lambda *arguments, **options: {})
    monkeypatch.setattr(structure, "_attempt", lambda *arguments, **options: next(left))
    monkeypatch.setattr(structure, "_finished", finished)
    solve_structure({f"cam{index}": [noise(0)] for index in range(4)}, lens="pinhole")
    assert taken == [attempts[1]]


def test_what_is_stated_wrongly_is_not_the_last_word() -> None:
    rig, pictures = filmed_room()
    found = solve_structure(pictures, lens="radial", focals=dict.fromkeys(rig, 3000.0))
    assert found.missing == ()
    for error in calibration_errors(found.cameras, rig).values():
        assert abs(error.focal_percent) < 1.5
