# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
import torch

from structgstream.data.lenses import Fisheye, LensCamera, RadialTangential
from structgstream.preparation.calibration.keypoints import (
    agreeing_matches,
    camera_rays,
    epipolar_angles,
    epipolar_pixels,
)
from tests.support.filmed import ring
from tests.support.views_made import cloud, keypoints_of, matches_of

LENS = RadialTangential(k1=-0.12, k2=0.02, p1=0.001)
RIG = ring(3, radius=2.6, arc_degrees=40, lens=LENS)
POINTS = cloud(80)


@pytest.mark.parametrize("lens", [LENS, Fisheye(0.02, -0.005)])
def test_rays_point_to_what_was_seen(lens: RadialTangential | Fisheye) -> None:
    for filmed in ring(2, radius=2.6, arc_degrees=40, lens=lens).values():
        towards = POINTS - filmed.camera.center.numpy()
        found = camera_rays(filmed, filmed.pixels(POINTS))
        np.testing.assert_allclose(found, towards / np.linalg.norm(towards, axis=1, keepdims=True), atol=1e-7)


def two(x: float = 1.0) -> tuple[LensCamera, LensCamera]:
    """The first camera, and it again, moved along the world's x axis."""
    one = RIG["cam00"]
    viewmat = one.camera.viewmat.clone()
    viewmat[:3, 3] -= viewmat[:3, :3] @ torch.tensor([x, 0.0, 0.0], dtype=torch.float64)
    moved = type(one.camera)(viewmat, one.camera.K, one.camera.width, one.camera.height)
    return one, LensCamera(moved, one.lens)


def unit(*vector: float) -> np.ndarray:
    return np.array([vector]) / np.linalg.norm(vector)


@pytest.mark.parametrize(
    ("second", "degrees"),
    [
        ((-0.4, 0.0, 1.0), 0.0),  # meets the first ray ahead
        ((-0.4, 0.035, 1.0), 2.005),  # two degrees above the plane, in the plane through the base
        ((0.4, 0.0, 1.0), 90.0),  # parts from it, so they meet behind
        ((0.0, 0.0, 1.0), 0.0),  # parallel: meets it at infinity
    ],
)
def test_angles_to_the_epipolar_plane(second: tuple[float, float, float], degrees: float) -> None:
    """The base is the x axis and the first ray the z axis: the plane is y = 0."""
    found = epipolar_angles(two(), (unit(0, 0, 1), unit(*second)))
    assert np.degrees(found[0]) == pytest.approx(degrees, abs=1e-3)


def test_cameras_of_one_place_agree_where_rays_are_the_same() -> None:
    found = epipolar_angles(two(0.0), (unit(0, 0, 1), unit(0, np.sin(0.1), np.cos(0.1))))
    assert found[0] == pytest.approx(0.1)


def test_matches_off_their_plane_go() -> None:
    """Half of the keypoints of a camera are moved across their epipolar lines by two pixels of 420: 0.27 degrees."""
    rig = ring(2, radius=2.6, arc_degrees=40)
    keypoints, matches = keypoints_of(rig, POINTS), matches_of(rig, POINTS)
    keypoints["cam01"].pixels[::2, 1] += 2.0
    near = agreeing_matches(keypoints, matches, rig, degrees=0.1)["cam00", "cam01"]
    kept = matches["cam00", "cam01"]
    assert near.tolist() == kept[kept[:, 0] % 2 == 1].tolist()
    far = epipolar_pixels(keypoints, matches, rig)["cam00", "cam01"]
    assert far[kept[:, 0] % 2 == 1].max() < 1e-3
    # Lines are not quite rows, and rays beside the axis are longer than the focal length.
    assert np.median(far[kept[:, 0] % 2 == 0]) == pytest.approx(2.0, abs=0.25)
