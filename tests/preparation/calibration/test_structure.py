# SPDX-License-Identifier: Apache-2.0
"""Structure from motion of a room whose truth is known."""

import logging
from dataclasses import replace
from functools import cache
from itertools import count
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from structgstream.data.calibration import rotation_matrix
from structgstream.data.lenses import LensCamera, RadialTangential
from structgstream.errors import CalibrationError
from structgstream.preparation.calibration import structure
from structgstream.preparation.calibration.keypoints import Keypoints, all_keypoints
from structgstream.preparation.calibration.solved import SolvedCalibration
from structgstream.preparation.calibration.structure import Refinement, refine, solve_structure
from tests.support.calibration_errors import calibration_errors
from tests.support.filmed import Film, filmed_room, noise_texture, ring, room


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
    for name, own in all_keypoints(pictures).items():
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


def test_shared_intrinsics_of_two_sizes_are_refused() -> None:
    _, pictures = filmed_room()
    smaller = pictures | {"cam04": [np.ascontiguousarray(pictures["cam04"][0][::2, ::2])]}
    with pytest.raises(CalibrationError, match="Shared intrinsics need pictures of one size"):
        solve_structure(smaller, intrinsics="shared")


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
        return SimpleNamespace(missing=(), roving=None)

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


def perturbed(rig: dict[str, LensCamera], *, degrees: float, percent: float) -> dict[str, LensCamera]:
    """Every camera turned by ``degrees``, moved by ``percent`` of the radius and zoomed by ``percent``, at random."""
    generator = np.random.default_rng(5)
    found = {}
    for name, one in rig.items():
        viewmat, K = one.camera.viewmat.clone(), one.camera.K.clone()
        axis, step = generator.normal(size=(2, 3))
        turn = torch.from_numpy(rotation_matrix(axis / np.linalg.norm(axis) * np.radians(degrees)))
        viewmat[:3] = turn @ viewmat[:3]
        viewmat[:3, 3] += torch.from_numpy(step / np.linalg.norm(step) * percent / 100 * 2.6)
        K[[0, 1], [0, 1]] *= 1 + percent / 100 * generator.choice([-1, 1])
        found[name] = replace(one, camera=replace(one.camera, viewmat=viewmat, K=K))
    return found


@cache
def refined() -> tuple[dict[str, LensCamera], Refinement]:
    rig, pictures = filmed_room()
    given = perturbed(rig, degrees=0.3, percent=1.0)
    return given, refine(pictures, given)


def test_perturbed_poses_come_back_where_they_were() -> None:
    rig, (given, found) = filmed_room()[0], refined()
    assert found.changed
    assert found.before_pixels > 0.8
    assert found.after_pixels < 0.3
    assert found.held_out > 100
    errors = {
        key: calibration_errors(cameras, rig) for key, cameras in (("given", given), ("ours", found.solved.cameras))
    }
    for name in rig:
        assert errors["given"][name].rotation_degrees > 0.15
        assert errors["ours"][name].rotation_degrees < 0.12
        assert errors["ours"][name].position_percent < 0.8
    # The gauge is the given cameras', so the mean of the positions stays, and the scale within what they are off.
    means = [
        np.mean([c.camera.center.numpy() for c in cameras.values()], 0) for cameras in (found.solved.cameras, given)
    ]
    np.testing.assert_allclose(*means, atol=1e-6)
    assert np.median(found.solved.errors()) < 0.3


def test_tracks_that_judged_are_adjusted_to_as_well(monkeypatch: pytest.MonkeyPatch) -> None:
    """One in five is held back until the refinement is accepted; what is returned is made from all."""
    given, found = refined()
    judge, calls = structure._judged, count()
    # The third judgement is that of what is made from all.
    monkeypatch.setattr(structure, "_judged", lambda *of: judge(*of) if next(calls) < 2 else float("inf"))
    judged = refine(filmed_room()[1], given)
    assert found.changed
    assert (found.after_pixels, found.held_out) == (judged.after_pixels, judged.held_out)
    assert len(found.solved.observations) > 1.15 * len(judged.solved.observations)


def test_a_lens_that_was_not_known_is_found() -> None:
    rig, pictures = filmed_room()
    given = {name: replace(one, lens=RadialTangential(k1=-0.06)) for name, one in rig.items()}
    found = refine(pictures, given, lens="radial")
    assert found.changed
    before, after = calibration_errors(given, rig), calibration_errors(found.solved.cameras, rig)
    for name in rig:
        assert after[name].lens_pixels < 0.5 * before[name].lens_pixels


def test_what_refining_makes_worse_is_given_back(monkeypatch: pytest.MonkeyPatch) -> None:
    """An adjustment that goes wrong is noticed by the matches that it did not see."""
    rig, pictures = filmed_room()
    wrong = perturbed(rig, degrees=0.5, percent=1.0)
    monkeypatch.setattr(structure, "cameras_of", lambda model: wrong)
    found = refine(pictures, rig, metres=True)
    assert not found.changed
    assert found.after_pixels > found.before_pixels
    assert found.solved.metres
    for name, one in found.solved.cameras.items():
        assert one is rig[name]
    assert len(found.solved.points) > 200


def test_a_camera_that_is_far_off_is_named() -> None:
    rig, pictures = filmed_room()
    away = perturbed(rig, degrees=25.0, percent=0.0)["cam03"]
    with pytest.raises(CalibrationError, match="agree with the given poses of 'cam03' to refine them"):
        refine(pictures, rig | {"cam03": away})


@cache
def walked_room() -> tuple[dict[str, LensCamera], dict[str, list[NDArray[np.uint8]]], dict[str, NDArray[np.uint8]]]:
    """Three cameras too far apart for structure from motion, and frames of another one that is carried past them."""
    rig = ring(3, radius=2.6, arc_degrees=120, focal=290, lens=RadialTangential(k1=-0.12, k2=0.02), size=(320, 240))
    path = ring(9, radius=2.4, arc_degrees=124, focal=250, lens=RadialTangential(k1=0.05), size=(320, 240))
    pictures = {
        name: [Film(one).picture(room(), noise=1, seed=number)] for number, (name, one) in enumerate(rig.items())
    }
    frames = {
        f"roving/{number}": Film(one).picture(room(), noise=1, seed=50 + number)
        for number, one in enumerate(path.values())
    }
    return rig, pictures, frames


def test_a_roving_video_connects_cameras_that_see_too_little_in_common(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(structure, "FIELDS_OF_VIEW", {"radial": (60.0,)})
    rig, pictures, frames = walked_room()
    found = solve_structure(pictures, lens="radial", roving=frames)
    assert (found.missing, list(found.cameras)) == ((), list(rig))
    assert set(found.observations.camera) == {0, 1, 2}
    roving = found.roving
    assert roving is not None
    assert (len(roving.cameras), roving.looked_at) == (9, 9)
    assert roving.bridged == tuple(rig)
    assert roving.median_pixels < 0.4
    assert len({(one.lens, tuple(one.camera.K.flatten().tolist())) for one in roving.cameras.values()}) == 1
    for error in calibration_errors(found.cameras, rig).values():
        assert error.rotation_degrees < 0.3
        assert error.position_percent < 1
    centers = np.stack([one.camera.center.numpy() for one in found.cameras.values()])
    np.testing.assert_allclose(centers.mean(0), 0, atol=1e-9)  # of the still cameras alone


def test_a_roving_video_of_another_place_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(structure, "FIELDS_OF_VIEW", {"radial": (60.0,)})
    _, pictures, _ = walked_room()
    elsewhere = {f"roving/{number}": noise(500 + number)[:120, :160] for number in range(4)}
    with pytest.raises(CalibrationError, match="No roving frame can be placed among the cameras"):
        solve_structure(pictures, lens="radial", roving=elsewhere)


def test_a_blurred_roving_video_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(structure, "FIELDS_OF_VIEW", {"radial": (60.0,)})
    _, pictures, frames = walked_room()
    blurred = {name: np.asarray(cv2.GaussianBlur(frame, (0, 0), 12), np.uint8) for name, frame in frames.items()}
    with pytest.raises(
        CalibrationError, match="The roving video is blurred, or of bare surfaces: its sharpest frames have"
    ):
        solve_structure(pictures, lens="radial", roving=dict(list(blurred.items())[:4]))
