# SPDX-License-Identifier: Apache-2.0
import sys
from dataclasses import replace

import numpy as np
import pytest

from structgstream.data.lenses import Fisheye, Lens, Pinhole, RadialTangential
from structgstream.errors import MissingExtraError
from structgstream.preparation.calibration.colmap import (
    colmap_camera,
    colmap_pose,
    field_of_view,
    filmed_camera,
    guessed_camera,
    pycolmap_module,
)
from structgstream.preparation.calibration.lens_terms import LensModel
from tests.support.filmed import ring

FILMED = ring(2, radius=2.0, arc_degrees=40)["cam01"]
LENSES = [
    Pinhole(),
    RadialTangential(k1=-0.2, k2=0.05),
    RadialTangential(-0.2, 0.05, 0.001, -0.002),
    RadialTangential(-0.2, 0.05, 0.001, -0.002, 0.01, 0.02, 0.01, 0.001),
    Fisheye(0.05, -0.01, 0.002, -0.001),
]


@pytest.mark.parametrize("lens", LENSES)
def test_a_camera_comes_back_as_it_went(lens: Lens) -> None:
    filmed = replace(FILMED, lens=lens)
    found = filmed_camera(colmap_camera(filmed, 7), colmap_pose(filmed.camera.viewmat.numpy()))
    assert found.lens == lens
    np.testing.assert_allclose(found.camera.K, filmed.camera.K)
    np.testing.assert_allclose(found.camera.viewmat, filmed.camera.viewmat, atol=1e-12)


@pytest.mark.parametrize("lens", LENSES)
def test_both_put_points_in_the_same_pixels(lens: Lens) -> None:
    """Which holds the order of the parameters, and where pixels are counted from."""
    filmed = replace(FILMED, lens=lens)
    points = np.random.default_rng(0).uniform(-0.4, 0.4, (30, 3))
    local = points @ filmed.camera.viewmat[:3, :3].numpy().T + filmed.camera.viewmat[:3, 3].numpy()
    theirs = colmap_camera(filmed, 1).img_from_cam(local)
    np.testing.assert_allclose(filmed.pixels(points), theirs, atol=1e-8)


def test_a_radial_model_has_one_focal_length() -> None:
    filmed = replace(FILMED, lens=RadialTangential(k1=-0.1))
    found = filmed_camera(colmap_camera(filmed, 1, model="RADIAL"), colmap_pose(np.eye(4)))
    assert found.lens == filmed.lens
    np.testing.assert_allclose(found.camera.K, filmed.camera.K)


def test_what_is_missing_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    with pytest.raises(MissingExtraError, match=r"structgstream\[sfm\]"):
        pycolmap_module()


@pytest.mark.parametrize(("lens", "degrees"), [("pinhole", 60), ("radial", 85), ("opencv", 40), ("fisheye", 150)])
@pytest.mark.parametrize("size", [(640, 480), (480, 640)])
def test_the_longer_side_spans_the_angle(lens: LensModel, degrees: float, size: tuple[int, int]) -> None:
    camera = guessed_camera(lens, 3, size, degrees)
    assert (camera.camera_id, camera.width, camera.height) == (3, *size)
    assert camera.has_prior_focal_length
    assert field_of_view(lens, camera.mean_focal_length(), size) == pytest.approx(degrees)
    filmed = filmed_camera(camera, pycolmap_module().Rigid3d())
    middle = np.array(size) / 2
    rim = np.where(np.arange(2) == np.argmax(size), 0.0, middle)
    across = filmed.to_normalized(rim[None])[0]
    assert 2 * np.degrees(np.arctan(np.linalg.norm(across))) == pytest.approx(degrees, abs=1e-3)
    np.testing.assert_allclose(filmed.to_normalized(middle[None]), 0, atol=1e-9)
