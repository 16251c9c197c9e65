# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace
from functools import cache
from itertools import count

import numpy as np
import pytest
import torch

from structgstream.data.calibration import rotation_matrix
from structgstream.data.lenses import LensCamera, RadialTangential
from structgstream.errors import CalibrationError, ConfigError
from structgstream.preparation.calibration import structure
from structgstream.preparation.calibration.structure import Refinement, refine
from tests.support.calibration_errors import calibration_errors
from tests.support.filmed import filmed_room


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


def test_a_lens_that_cannot_be_refined_is_refused() -> None:
    rig, pictures = filmed_room()
    with pytest.raises(ConfigError, match="model brown cannot be refined; take opencv"):
        refine(pictures, rig, lens="brown")
