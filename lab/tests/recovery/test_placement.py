# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest
import torch

from lab.recovery.placement import exactly_placed, own_errors
from structgstream.data.calibration import Alignment, rotation_matrix
from structgstream.data.lenses import LensCamera
from tests.support.repetitive import ring


def dollied(filmed: LensCamera) -> LensCamera:
    """Farther back by a tenth of its distance of three, and zoomed by as much: at one depth nobody can tell."""
    viewmat, K = filmed.camera.viewmat.clone(), filmed.camera.K.clone()
    viewmat[2, 3] += 0.3
    K[[0, 1], [0, 1]] *= 1.1
    return replace(filmed, camera=replace(filmed.camera, viewmat=viewmat, K=K))


def test_a_similarity_is_no_error() -> None:
    truth = ring()
    moved = Alignment(2.5, rotation_matrix(np.array([0.3, 0.2, -0.5])), np.array([1.0, 2.0, 3.0]))
    errors = own_errors({name: moved.filmed(filmed) for name, filmed in truth.items()}, truth, depths=(1.0, 3.0))
    assert max(errors.values()) < 1e-3


def test_a_camera_farther_back_with_a_longer_focal_length_is_off_for_near_things() -> None:
    truth = ring()
    estimate = truth | {"cam2": dollied(truth["cam2"])}
    errors = own_errors(estimate, truth, depths=(0.8, 1.6))
    assert max(errors, key=lambda name: errors[name]) == "cam2"
    assert errors["cam2"] > 4 * sorted(errors.values())[-2]


def test_a_camera_is_put_where_it_is_exact_among_the_others() -> None:
    truth = ring()
    moved = Alignment(0.5, np.eye(3), np.array([1.0, 0.0, 0.0]))
    estimate = {name: moved.filmed(filmed) for name, filmed in truth.items()}
    found = exactly_placed("cam2", estimate | {"cam2": dollied(estimate["cam2"])}, truth)
    torch.testing.assert_close(found.camera.center, estimate["cam2"].camera.center, atol=2e-3, rtol=0)
    assert float(found.camera.K[0, 0]) == pytest.approx(600, rel=1e-3)
