# SPDX-License-Identifier: Apache-2.0
"""Paths stay near the rig and look where it looks."""

import pytest
import torch

from structgstream.cameras import Camera, CameraRig
from structgstream.errors import ConfigError
from structgstream.evaluation.camera_path import arc, central_camera, focus_point, free_near, looking, orbit
from tests.support.rigs import arc_rig, look_at


def forward_rig() -> CameraRig:
    """Cameras in a plane that all look along z."""
    K = torch.tensor([[40.0, 0, 24], [0, 40.0, 16], [0, 0, 1]], dtype=torch.float64)
    cameras = {}
    for i, x in enumerate((-1.0, 0.0, 1.0)):
        viewmat = torch.eye(4, dtype=torch.float64)
        viewmat[0, 3] = -x
        cameras[f"cam{i}"] = Camera(viewmat, K, 48, 32, near=0.1)
    return CameraRig(cameras)


def pixel(camera: Camera, point: torch.Tensor) -> torch.Tensor:
    """Where ``camera`` sees ``point``."""
    seen = camera.K @ (camera.viewmat[:3, :3] @ point + camera.viewmat[:3, 3])
    return seen[:2] / seen[2]


def test_a_rig_that_looks_at_a_point_has_it_as_focus() -> None:
    torch.testing.assert_close(focus_point(arc_rig(6)), torch.zeros(3, dtype=torch.float64), atol=1e-9, rtol=0)


def test_parallel_cameras_look_ahead() -> None:
    focus = focus_point(forward_rig())
    torch.testing.assert_close(focus, torch.tensor([0.0, 0.0, 2.0], dtype=torch.float64))


@pytest.mark.parametrize("rig", [arc_rig(6), forward_rig()])
def test_an_orbit_stays_near_its_camera_and_keeps_what_it_looks_at(rig: CameraRig) -> None:
    name = central_camera(rig)
    path = orbit(rig, 12)
    centre = rig[name].center
    nearest = (rig.centers - centre).norm(dim=1).sort().values[1:4].mean()
    assert all((camera.center - centre).norm() <= 0.51 * nearest for camera in path)
    assert (path[3].center - path[9].center).norm() > 0.9 * nearest
    middle = torch.tensor([path[0].width / 2, path[0].height / 2], dtype=torch.float64)
    targets = [pixel(camera, focus_point(rig)) for camera in path]
    assert all((target - middle).norm() < 12 for target in targets)


def test_an_orbit_circles_the_camera_that_is_named() -> None:
    rig = arc_rig(6)
    path = orbit(rig, 8, around="cam05")
    centre = torch.stack([camera.center for camera in path]).mean(0)
    torch.testing.assert_close(centre, rig["cam05"].center, atol=0.02, rtol=0)
    with pytest.raises(ConfigError, match=r"no camera 'x'.*cam00"):
        orbit(rig, 8, around="x")


def test_an_arc_goes_from_one_camera_to_the_other_at_their_distance() -> None:
    rig = arc_rig(6)
    path = arc(rig, 7, between=("cam01", "cam05"))
    torch.testing.assert_close(path[0].center, rig["cam01"].center, atol=1e-9, rtol=0)
    torch.testing.assert_close(path[-1].center, rig["cam05"].center, atol=1e-9, rtol=0)
    distances = torch.stack([camera.center.norm() for camera in path])
    torch.testing.assert_close(distances, distances[0].expand(7))


def test_an_arc_without_ends_takes_training_cameras_well_apart() -> None:
    rig = arc_rig(6)
    path = arc(rig, 3)
    ends = {tuple(path[i].center.tolist()) for i in (0, -1)}
    wanted = {tuple(rig[name].center.tolist()) for name in ("cam01", "cam05")}
    assert torch.allclose(torch.tensor(sorted(ends)), torch.tensor(sorted(wanted)))


def test_looking_gives_the_rotation_of_the_tests_own_camera() -> None:
    rig = arc_rig(4)
    camera = rig["cam02"]
    eye, target = torch.tensor([1.0, -2.0, -3.0]).double(), torch.tensor([0.1, 0.2, 0.3]).double()
    down = torch.tensor([0.0, 1.0, 0.0]).double()
    torch.testing.assert_close(looking(camera, eye, target, down, rig).viewmat, look_at(eye, target))


def test_a_near_plane_stays_where_it_is_for_who_advances_and_at_its_distance_for_who_steps_aside() -> None:
    rig = arc_rig(4)
    camera = rig["cam02"]
    right, down, forward = camera.viewmat[:3, :3]
    assert free_near(rig, camera.center) == camera.near
    # From a little ahead, what lies just beyond the camera's near plane is still drawn.
    assert free_near(rig, camera.center + 0.04 * forward) == pytest.approx(camera.near - 0.04)
    for distance in (0.2, 1.0):
        assert free_near(rig, camera.center + distance * forward) == pytest.approx(0.01 * camera.near)
    for aside in (0.1 * right, -0.1 * down, -0.3 * forward, 0.1 * right - 0.3 * forward):
        assert free_near(rig, camera.center + aside) == pytest.approx(camera.near)
    assert free_near(rig, camera.center + 0.1 * right + 0.04 * forward) == pytest.approx(camera.near - 0.04)
