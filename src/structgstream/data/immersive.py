# SPDX-License-Identifier: Apache-2.0
"""The layout of Google Immersive (Broxton et al., SIGGRAPH 2020): ``models.json`` and one video a camera.

Each entry has ``name``, ``width``, ``height``, ``focal_length``, ``principal_point``, ``radial_distortion`` (OpenCV's
fisheye; the first two are used, as published loaders do), ``orientation`` (a rotation vector, world to camera) and
``position`` (of the camera in the world). The first camera is held out.

Published results undistort to pinholes of the same size and principal point with half the focal length, and take half
of that size (``--scale 0.5``, 1280x960); so does this reader, in one step. What the lens does not show is black.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from structgstream.cameras import Camera
from structgstream.data.calibration_files.reading import calibration_of, readable
from structgstream.data.lenses import LensCamera, fisheye_lens, from_integer_centers
from structgstream.data.posed import Calibration, PosedCamera, intrinsics, rigid, rotation_matrix
from structgstream.data.posed_capture import open_posed
from structgstream.data.source import FrameSource
from structgstream.data.text_files import number, pixels, read_json

MODELS = "models.json"
HELD_OUT = "camera_0001"
FOCAL_SHARE = 0.5
EXPECTED = (
    "a list of cameras with name, width, height, focal_length, principal_point, radial_distortion, orientation "
    "and position"
)


def recognizes_immersive(path: Path) -> bool:
    """Whether the folder has this layout."""
    return (path / MODELS).is_file()


def open_immersive(path: Path) -> FrameSource:
    """The capture at ``path``, undistorted; a video without calibration, which some takes have, is left out.

    Raises:
        CaptureError: a video cannot be read.
        CalibrationError: a broken file, or videos of other proportions than it says.
    """
    return open_posed(path, read_models(path / MODELS), target=_as_published, complete=False)


def _as_published(filmed: LensCamera) -> Camera:
    shares = torch.tensor([[FOCAL_SHARE, 1, 1], [1, FOCAL_SHARE, 1], [1, 1, 1]], dtype=torch.float64)
    return replace(filmed.camera, K=filmed.camera.K * shares)


def read_models(file: Path) -> Calibration:
    """The cameras of ``models.json``.

    Raises:
        CalibrationError: the file cannot be read.
    """
    with readable(file, EXPECTED):
        entries = [(str(entry["name"]), entry) for entry in read_json(file)]
    return replace(calibration_of(entries, _camera, file=file, expected=EXPECTED), held_out=(HELD_OUT,))


def _camera(name: str, entry: dict[str, Any]) -> PosedCamera:
    focal, (cx, cy) = number(entry["focal_length"]), entry["principal_point"]
    rotation = rotation_matrix(np.array(entry["orientation"], dtype=np.float64).reshape(3))
    viewmat = rigid(rotation, -rotation @ np.array(entry["position"], dtype=np.float64))
    return PosedCamera(
        name=name,
        viewmat=viewmat,
        K=from_integer_centers(intrinsics(focal, focal * number(entry.get("pixel_aspect_ratio", 1)), cx, cy)),
        size=pixels((entry["width"], entry["height"])),
        lens=fisheye_lens(entry["radial_distortion"][:2]),
    )
