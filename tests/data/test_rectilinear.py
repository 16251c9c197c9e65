# SPDX-License-Identifier: Apache-2.0
"""The pinhole that pictures of a lens are undistorted for."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from structgstream.data.lenses import Fisheye, Pinhole
from structgstream.data.undistortion import WIDEST_DEGREES, rectilinear, shows
from structgstream.errors import CalibrationError, ConfigError
from tests.support.lens_cameras import MILD, WIDE, filmed


def test_a_wide_fisheye_stops_at_the_widest_that_a_plane_shows_well() -> None:
    camera = filmed(Fisheye(), 640 / math.radians(150), width=640, height=480)
    target = rectilinear(camera)
    assert math.degrees(2 * math.atan(320 / float(target.K[0, 0]))) == pytest.approx(WIDEST_DEGREES)
    wide = rectilinear(camera, degrees=140)
    assert float(wide.K[0, 0]) == pytest.approx(320 / math.tan(math.radians(70)))


def test_a_lens_shows_what_its_picture_holds() -> None:
    camera = filmed(Pinhole(), 400.0, width=640, height=480)
    centers = np.array([[0.5, 0.5], [639.5, 479.5], [320.0, 240.0], [0.4, 240.0], [320.0, 480.0]])
    assert shows(camera, camera.to_normalized(centers)).tolist() == [True, True, True, False, False]
    assert not shows(filmed(MILD), np.array([[50.0, 0.0]]))[0], "beyond where the model can be inverted"


def test_a_pinhole_stays_as_it_is() -> None:
    camera = filmed(Pinhole())
    assert rectilinear(camera) is not camera.camera
    assert torch.equal(rectilinear(camera).K, camera.camera.K)
    half = rectilinear(camera, size=(160, 120))
    assert torch.equal(half.K, camera.camera.resized(160, 120).K)


def test_what_cannot_be_made_is_refused() -> None:
    with pytest.raises(ConfigError, match="cannot show 180 degrees"):
        rectilinear(filmed(WIDE), degrees=180)
    with pytest.raises(ConfigError, match="0x10 pixels"):
        rectilinear(filmed(WIDE), size=(0, 10))
    off = filmed(MILD)
    K = off.camera.K.clone()
    K[0, 2] = -40
    with pytest.raises(CalibrationError, match="belong to another picture"):
        rectilinear(replace(off, camera=replace(off.camera, K=K)))
