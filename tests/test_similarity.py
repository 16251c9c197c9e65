# SPDX-License-Identifier: Apache-2.0
import torch

from structgstream.cameras import Similarity, normalizing_similarity, rig_radius
from tests.support.rigs import arc_rig


def pixel(camera, point):
    p = camera.K @ (camera.viewmat[:3, :3] @ point + camera.viewmat[:3, 3])
    return p[:2] / p[2]


def test_normalised_cameras_see_normalised_points_in_the_same_pixels() -> None:
    rig = arc_rig()
    similarity = Similarity(center=(0.5, -1.0, 2.0), scale=0.3)
    point = torch.tensor([0.3, 0.2, 0.4], dtype=torch.float64)
    for name in rig:
        assert torch.allclose(pixel(rig[name], point), pixel(similarity.camera(rig[name]), similarity.points(point)))


def test_inverse_gives_the_captures_units_back() -> None:
    similarity = Similarity(center=(0.5, -1.0, 2.0), scale=0.3)
    points = torch.randn(7, 3, dtype=torch.float64)
    assert torch.allclose(similarity.inverse_points(similarity.points(points)), points)


def test_every_rig_comes_to_the_same_radius() -> None:
    for radius in (0.4, 50.0):
        rig = arc_rig(radius=radius)
        normalised = normalizing_similarity(rig, radius=1.0).rig(rig)
        assert abs(rig_radius(normalised) - 1.0) < 1e-9
        assert normalised["cam01"].near == rig["cam01"].near / rig_radius(rig)


def test_held_out_cameras_do_not_move_the_scene() -> None:
    rig = arc_rig(5)
    with_other_held_out = rig.mapped({**rig.cameras, "cam00": rig["cam03"]})
    assert normalizing_similarity(rig, radius=1.0) == normalizing_similarity(with_other_held_out, radius=1.0)
