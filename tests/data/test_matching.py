# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest
import torch

from structgstream.data.matching import (
    Features,
    back_project,
    epipolar_errors,
    fundamental_matrix,
    guided_matches,
    inside,
    level_normal,
    neighbor_views,
    project,
    sift_features,
    triangulate,
    unique_pairs,
    viewing_distance,
)
from tests.support.planes import distance_to_surface, room_frame, room_rig
from tests.support.rigs import arc_rig

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
    neighbours = neighbor_views(cameras, count=2, distance=3.0)
    assert all(len(others) == 2 and name not in others for name, others in neighbours.items())
    pairs = unique_pairs(neighbours)
    assert len({frozenset(pair) for pair in pairs}) == len(pairs)


def test_keypoints_matched_along_their_lines_triangulate_onto_the_planes() -> None:
    rig = room_rig()
    frame = room_frame(rig)
    cameras = rig["cam02"], rig["cam03"]
    first, second = (sift_features(frame.images[name], count=1000) for name in ("cam02", "cam03"))
    matches = guided_matches(first, second, cameras, line_pixels=1.5, depth_range=(1.0, 6.0), ratio=0.85)
    assert len(matches) > 150
    assert len(np.unique(matches[:, 0])) == len(np.unique(matches[:, 1])) == len(matches)
    points, depths = triangulate(*cameras, first.pixels[matches[:, 0]], second.pixels[matches[:, 1]])
    assert ((depths > 1.0) & (depths < 6.0)).all()
    assert np.median(distance_to_surface(points)) < 0.02
    assert (distance_to_surface(points) < 0.1).mean() > 0.9


def test_texture_that_repeats_along_the_line_is_not_matched() -> None:
    """Two candidates with one look on one epipolar line: the ratio test drops both, unless they coincide."""
    cameras = room_rig()["cam02"], room_rig()["cam03"]
    point = np.array([[0.0, 0.1, 0.4]])
    further = back_project(cameras[0], project(cameras[0], point)[0], project(cameras[0], point)[1] * 1.3)
    look = np.zeros((1, 128), np.float32)
    look[0, 0] = 1
    query = Features(project(cameras[0], point)[0], look)
    there, apart = project(cameras[1], point)[0], project(cameras[1], further)[0]

    def matched(pixels: np.ndarray) -> int:
        candidates = Features(pixels, np.repeat(look, len(pixels), 0))
        return len(guided_matches(query, candidates, cameras, line_pixels=1.5, depth_range=(1.0, 6.0), ratio=0.85))

    assert matched(there) == 1
    assert matched(np.concatenate([there, there + 0.5])) == 1
    assert matched(np.concatenate([there, apart])) == 0


def test_cameras_that_do_not_converge_fall_back_on_their_spread() -> None:
    cameras = {f"cam{i}": replace(room_rig()["cam02"], viewmat=shifted(i)) for i in range(5)}
    assert viewing_distance(cameras) == pytest.approx(5 * 2.0)


def shifted(steps: int) -> torch.Tensor:
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[0, 3] = -float(steps)
    return viewmat


def test_level_is_square_to_the_horizontal_axes_even_for_cameras_that_look_down() -> None:
    np.testing.assert_allclose(level_normal(dict(arc_rig(5).cameras)), [0, -1, 0], atol=1e-6)
