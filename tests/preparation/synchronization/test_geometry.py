# SPDX-License-Identifier: Apache-2.0
"""Epipolar geometry from calibrations and from static features."""

from collections.abc import Mapping

import cv2
import numpy as np

from structgstream.cameras import Camera
from structgstream.data.lenses import LensCamera, Pinhole, RadialTangential
from structgstream.data.matching import epipolar_errors, fundamental_matrix
from structgstream.preparation.synchronization.motion import CalibratedGeometry, StaticGeometry, static_features
from tests.support.takes import lenses, ring

POINTS = np.random.default_rng(0).uniform(-0.5, 0.5, (50, 3))


def worst(geometry: CalibratedGeometry, cameras: Mapping[str, LensCamera]) -> float:
    """Largest distance of points from their lines, in normalised coordinates."""
    pair = geometry.pair("cam0", "cam1")
    assert pair is not None
    first, second = (
        straight(cameras[name].pixels(POINTS)) for name, straight in zip(("cam0", "cam1"), pair.straighten)
    )
    return float(epipolar_errors(pair.F, first, second).max())


def test_points_lie_on_their_lines() -> None:
    cameras = lenses(ring(2))
    assert worst(CalibratedGeometry(cameras), cameras) < 1e-9
    bent = {name: LensCamera(own.camera, RadialTangential(k1=-0.1, p1=0.01)) for name, own in cameras.items()}
    assert worst(CalibratedGeometry(bent), bent) < 1e-6


def test_cameras_without_calibration_or_at_one_place_have_no_geometry() -> None:
    cameras = lenses(ring(2))
    assert CalibratedGeometry(cameras).pair("cam0", "other") is None
    assert CalibratedGeometry({**cameras, "cam1": cameras["cam0"]}).pair("cam0", "cam1") is None


def textured(camera: Camera) -> np.ndarray:
    """Two textured planes at different depths, as the camera sees them."""
    generator = np.random.default_rng(3)
    picture = np.zeros((camera.height, camera.width, 3), np.uint8)
    for depth, side in ((1.5, 5.0), (0.0, 1.6)):
        texture = cv2.resize(generator.integers(0, 255, (60, 60), np.uint8), (480, 480), interpolation=cv2.INTER_CUBIC)
        corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * side / 2 + [0, 0, depth]
        pixels = LensCamera(camera, Pinhole()).pixels(corners)
        square = np.array([[0, 0], [480, 0], [480, 480], [0, 480]], np.float32)
        H = cv2.getPerspectiveTransform(square, pixels.astype(np.float32))
        warped = cv2.warpPerspective(texture, H, (camera.width, camera.height))
        inside = cv2.warpPerspective(np.ones_like(texture), H, (camera.width, camera.height)) > 0
        picture[inside] = warped[inside][:, None]
    return picture


def test_static_features_give_the_geometry() -> None:
    cameras = {name: camera.resized(640, 480) for name, camera in ring(2, degrees=12).items()}
    features = {name: static_features([textured(camera)] * 3) for name, camera in cameras.items()}
    geometry = StaticGeometry(features, dict.fromkeys(cameras, (640, 480)))
    pair = geometry.pair("cam0", "cam1")
    assert pair is not None
    assert pair.estimated
    first, second = (LensCamera(camera, Pinhole()).pixels(POINTS) for camera in cameras.values())
    assert np.median(epipolar_errors(pair.F, first, second)) < 2
    assert np.median(epipolar_errors(fundamental_matrix(*cameras.values()), first, second)) < 1e-6


def test_views_without_texture_have_no_geometry() -> None:
    blank = np.full((60, 80, 3), 90, np.uint8)
    geometry = StaticGeometry({name: static_features([blank]) for name in "ab"}, dict.fromkeys("ab", (80, 60)))
    assert geometry.pair("a", "b") is None
