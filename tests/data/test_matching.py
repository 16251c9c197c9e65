# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from rigs import arc_rig
from structgstream.data.matching import (
    back_project,
    epipolar_errors,
    fundamental_matrix,
    inside,
    neighbour_views,
    project,
    triangulate,
    unique_pairs,
    viewing_distance,
)

POINTS = np.random.default_rng(0).uniform(-0.4, 0.4, (40, 3))


def test_projection_and_back_projection_are_inverse() -> None:
    camera = arc_rig()["cam02"]
    pixels, depths = project(camera, POINTS)
    np.testing.assert_allclose(back_project(camera, pixels, depths), POINTS, atol=1e-9)
    assert inside(camera, pixels, depths, near=0.1).any()
    assert not inside(camera, pixels, depths, near=100.0).any()


def test_matches_of_one_point_lie_on_each_others_epipolar_lines() -> None:
    first, second = arc_rig()["cam01"], arc_rig()["cam03"]
    a, b = project(first, POINTS)[0], project(second, POINTS)[0]
    F = fundamental_matrix(first, second)
    assert epipolar_errors(F, a, b).max() < 1e-6
    shifted = epipolar_errors(F, a, b + np.array([0.0, 3.0]))
    assert np.median(shifted) == pytest.approx(3.0, rel=0.2)


def test_two_rays_meet_where_they_came_from() -> None:
    first, second = arc_rig()["cam01"], arc_rig()["cam03"]
    points, depths = triangulate(first, second, project(first, POINTS)[0], project(second, POINTS)[0])
    np.testing.assert_allclose(points, POINTS, atol=1e-6)
    np.testing.assert_allclose(depths[:, 0], project(first, POINTS)[1], atol=1e-6)


def test_a_rig_that_looks_at_one_place_says_how_far_it_is() -> None:
    cameras = dict(arc_rig(5, radius=3.0).cameras)
    assert viewing_distance(cameras) == pytest.approx((3.0**2 + 0.3**2) ** 0.5, rel=0.05)


def test_every_pair_of_neighbours_comes_once() -> None:
    cameras = dict(arc_rig(5).cameras)
    neighbours = neighbour_views(cameras, count=2, distance=3.0)
    assert all(len(others) == 2 and name not in others for name, others in neighbours.items())
    pairs = unique_pairs(neighbours)
    assert len({frozenset(pair) for pair in pairs}) == len(pairs)
