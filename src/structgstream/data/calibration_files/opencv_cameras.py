# SPDX-License-Identifier: Apache-2.0
"""One file of OpenCV's ``FileStorage`` a camera, XML or YAML, named after it: OpenPose's and one's own.

OpenPose: ``CameraMatrix`` (3x4, world to camera), ``Intrinsics``, ``Distortion``. Others: ``camera_matrix`` or ``K``,
``distortion_coefficients`` or ``D``, ``R`` or ``rvec``, ``T`` or ``tvec``, ``image_width``, ``image_height``,
``fisheye_model``.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from structgstream.data.calibration_files.opencv_storage import is_storage, read_storage
from structgstream.data.calibration_files.reading import each_camera
from structgstream.data.lenses import fisheye_lens, from_integer_centers, opencv_lens
from structgstream.data.posed import Calibration, PosedCamera, rigid

EXPECTED = (
    "camera_matrix, distortion_coefficients, image_width, image_height and the camera's pose, R and T, or "
    "Intrinsics, Distortion and CameraMatrix (3x4)"
)
MATRIX = ("Intrinsics", "camera_matrix", "cameraMatrix", "K")
DISTORTION = ("Distortion", "distortion_coefficients", "dist_coeffs", "distCoeffs", "D")
ROTATION, TRANSLATION = ("R", "rvec", "rotation"), ("T", "t", "tvec", "translation")


def find(folder: Path) -> Iterator[tuple[Path, ...]]:
    """Every such file of the folder, together."""
    files = (file for file in sorted(folder.iterdir()) if file.suffix.lower() in (".xml", ".yml", ".yaml"))
    if found := tuple(file for file in files if file.is_file() and is_storage(file)):
        yield found


def read(files: tuple[Path, ...]) -> Calibration:
    """A camera for each file.

    Raises:
        CalibrationError: one is broken, or has no pose.
    """
    folder = files[0].parent
    cameras = each_camera(((file.stem, file) for file in files), _camera, file=folder, expected=EXPECTED)
    return Calibration(folder, cameras)


def _camera(name: str, file: Path) -> PosedCamera:
    content = read_storage(file)
    coefficients = _first(content, DISTORTION, ())
    if "Intrinsics" in content:
        pose = np.array(content["CameraMatrix"], dtype=np.float64).reshape(3, 4)
        viewmat = rigid(pose[:, :3], pose[:, 3])
    else:
        viewmat = rigid(_first(content, ROTATION), _first(content, TRANSLATION))
    width, height = content.get("image_width", 0), content.get("image_height", 0)
    return PosedCamera(
        name=name,
        viewmat=viewmat,
        K=from_integer_centers(_first(content, MATRIX)),
        size=(round(width), round(height)) if width and height else None,
        lens=(fisheye_lens if content.get("fisheye_model") else opencv_lens)(np.ravel(coefficients).tolist()),
    )


def _first(content: dict[str, Any], keys: tuple[str, ...], default: Any = None) -> Any:
    found = next((content[key] for key in keys if content.get(key) is not None), default)
    if found is None:
        raise KeyError(" or ".join(keys))
    return found
