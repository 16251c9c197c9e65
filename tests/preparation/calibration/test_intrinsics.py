# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from structgstream.preparation.calibration.colmap import field_of_view, filmed_camera, guessed_camera, pycolmap_module
from structgstream.preparation.calibration.lens_terms import LensModel


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
