# SPDX-License-Identifier: Apache-2.0
"""Rotations, poses and intrinsics of calibration files."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from structgstream.data.calibration import PosedCamera, intrinsics, rigid, rotation_matrix
from tests.support.properties import examples

VECTOR = st.tuples(*[st.floats(-4.0, 4.0)] * 3)


@given(VECTOR)
@examples(200)
def test_a_rotation_vector_is_as_opencv_reads_it(vector: tuple[float, float, float]) -> None:
    found = rotation_matrix(np.array(vector))
    np.testing.assert_allclose(found, cv2.Rodrigues(np.array(vector))[0], atol=1e-9)
    np.testing.assert_allclose(found @ found.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(found) == pytest.approx(1.0)


def test_no_rotation_is_the_identity() -> None:
    assert (rotation_matrix(np.zeros(3)) == np.eye(3)).all()
    assert (rotation_matrix(np.full(3, 1e-13)) == np.eye(3)).all()


@given(VECTOR, VECTOR)
@examples(100)
def test_a_pose_takes_a_vector_or_a_matrix(vector: tuple[float, ...], moved: tuple[float, ...]) -> None:
    turn = rotation_matrix(np.array(vector))
    one, other = rigid(vector, moved), rigid(turn, np.array(moved)[:, None])
    np.testing.assert_array_equal(one, other)
    np.testing.assert_allclose(one @ [*moved, 1.0], [*(turn @ moved + np.array(moved)), 1.0], atol=1e-12)
    camera = PosedCamera("a", one, np.eye(3), None)
    np.testing.assert_allclose(one @ [*camera.center, 1.0], [0, 0, 0, 1], atol=1e-9)


@pytest.mark.parametrize(
    ("turn", "move"), [(np.eye(2), [0, 0, 0]), ([0, 0], [0, 0, 0]), (np.eye(3), [0, 0]), (1.0, [0])]
)
def test_other_shapes_are_no_pose(turn: object, move: object) -> None:
    with pytest.raises(ValueError, match="a rotation of shape"):
        rigid(turn, move)  # type: ignore[arg-type]


def test_what_is_given_is_not_changed() -> None:
    turn = np.eye(3)
    rigid(turn, [1, 2, 3])[:3, :3] *= 2
    assert (turn == np.eye(3)).all()


def test_intrinsics() -> None:
    assert intrinsics(1, 2, 3, 4).tolist() == [[1, 0, 3], [0, 2, 4], [0, 0, 1]]
