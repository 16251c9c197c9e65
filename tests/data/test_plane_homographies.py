# SPDX-License-Identifier: Apache-2.0
"""Homographies against projections of points of a plane, and scores of the plane where a picture's surface is."""

import numpy as np
import torch

from structgstream.data.matching import back_project, project
from structgstream.data.plane_sweep import plane_homographies, sweep_view
from structgstream.kernels.backend import processor_backend
from tests.support.planes import room_depth, room_frame, room_rig


def test_a_homography_is_the_projection_of_points_of_its_plane() -> None:
    rig = room_rig()
    own, others = rig["cam02"], [rig["cam01"], rig["cam04"]]
    planes = np.array([[0.0, 0.0, 0.4], [0.1, -0.3, 0.5]])
    found = plane_homographies(own, others, planes)
    assert found.shape == (2, 2, 3, 3)
    pixels = np.array([[20.5, 30.5], [100.5, 70.5]])
    for of_plane, plane in zip(found, planes, strict=True):
        rays = np.column_stack([pixels, np.ones(2)]) @ np.linalg.inv(own.K.numpy()).T
        points = back_project(own, pixels, 1 / (rays @ plane))
        for homography, other in zip(of_plane, others, strict=True):
            there = np.column_stack([pixels - 0.5, np.ones(2)]) @ homography.T
            expected, depths = project(other, points)
            np.testing.assert_allclose(there[:, :2] / there[:, 2:] + 0.5, expected, atol=1e-9)
            np.testing.assert_allclose(there[:, 2], depths * (rays @ plane), rtol=1e-9)


def test_a_picture_scores_best_on_the_plane_that_it_shows() -> None:
    rig = room_rig()
    frame, names = room_frame(rig), ["cam02", "cam01", "cam03"]
    views = [sweep_view(rig[name], frame.images[name], width=160) for name in names]
    depth = room_depth(views[0].camera)
    depths = np.array([1.5, 2.5, 3.6])
    homographies = plane_homographies(
        views[0].camera, [view.camera for view in views[1:]], np.array([[0.0, 0.0, 1 / d] for d in depths])
    )
    scores = processor_backend().plane_scores(
        torch.from_numpy(views[0].grey),
        [torch.from_numpy(view.grey) for view in views[1:]],
        torch.from_numpy(homographies),
        window=5,
        noise=0.008**2,
    )
    for number in (1, 2):
        there = np.abs(depth - depths[number]) < 0.05
        assert there.sum() > 100
        assert (scores.argmax(0).numpy()[there] == number).mean() > 0.9
        assert scores[number].numpy()[there].mean() > 0.8
