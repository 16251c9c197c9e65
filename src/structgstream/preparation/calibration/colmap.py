# SPDX-License-Identifier: Apache-2.0
"""The module pycolmap, and cameras as values of it.

Both count pixels from the picture's corner, with the centre of the top-left pixel at (0.5, 0.5), and both have world to
camera poses with OpenCV axes, so nothing is converted but names and orders of parameters.
"""

import math
from collections.abc import Mapping
from dataclasses import astuple
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from structgstream.data.calibration import rigid
from structgstream.data.lenses import Fisheye, Lens, LensCamera, Pinhole, RadialTangential
from structgstream.data.prepared import camera_of
from structgstream.errors import import_extra
from structgstream.preparation.calibration.lens_terms import LensModel

MODELS: dict[LensModel, str] = {
    "pinhole": "PINHOLE",
    "radial": "RADIAL",
    "opencv": "OPENCV",
    "brown": "OPENCV",  # none of COLMAP's ends at k3, which is added after its models (bundle.py)
    "fisheye": "OPENCV_FISHEYE",
}
TERMS_OF = {"PINHOLE": 0, "RADIAL": 2, "OPENCV": 4, "OPENCV_FISHEYE": 4, "FULL_OPENCV": 8}  # of distortion
QUIET = 3  # COLMAP logs every step and every failed start; results are reported by the callers


def pycolmap_module() -> ModuleType:
    """The module ``pycolmap``, from the extra ``sfm``, with its log level lowered."""
    pycolmap = import_extra("pycolmap", "sfm")
    pycolmap.logging.minloglevel = QUIET
    return pycolmap


def colmap_cameras(cameras: Mapping[str, LensCamera], models: Mapping[str, str] | None = None) -> dict[str, Any]:
    """:func:`colmap_camera` of each, numbered from 1 on, of ``models`` by name."""
    numbers = dict(zip(cameras, range(1, len(cameras) + 1), strict=True))
    return {name: colmap_camera(own, numbers[name], model=(models or {}).get(name)) for name, own in cameras.items()}


def colmap_camera(filmed: LensCamera, number: int, *, model: str | None = None) -> Any:
    """``filmed``'s intrinsics and lens as a camera of pycolmap with the id ``number``.

    ``model`` is a name of COLMAP's, at least as general as the lens; by default the smallest that holds it.
    """
    K = filmed.camera.K.numpy()
    model = model or holding(filmed.lens)
    focal = [(K[0, 0] + K[1, 1]) / 2] if model == "RADIAL" else [K[0, 0], K[1, 1]]
    terms = ([float(value) for value in astuple(filmed.lens)] + [0.0] * 8)[: TERMS_OF[model]]
    return pycolmap_module().Camera(
        camera_id=number,
        model=model,
        width=filmed.camera.width,
        height=filmed.camera.height,
        params=[*focal, K[0, 2], K[1, 2], *terms],
        has_prior_focal_length=True,
    )


def holding(lens: Lens) -> str:
    """The name of COLMAP's smallest model that holds ``lens``."""
    if isinstance(lens, Pinhole):
        return "PINHOLE"
    if isinstance(lens, Fisheye):
        return "OPENCV_FISHEYE"
    return "FULL_OPENCV" if lens.k3 or lens.k4 or lens.k5 or lens.k6 else "OPENCV"


def filmed_camera(camera: Any, cam_from_world: Any) -> LensCamera:
    """A camera of pycolmap and a pose as a :class:`LensCamera`."""
    values = [float(value) for value in camera.params]
    if camera.model_name == "RADIAL":
        values = [values[0], *values]
    fx, fy, cx, cy, *terms = values
    lens: Lens = Pinhole()
    if camera.model_name == "OPENCV_FISHEYE":
        lens = Fisheye(*terms)
    elif any(terms) or camera.model_name == "RADIAL":
        lens = RadialTangential(*terms)
    K, pose = [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], cam_from_world.matrix()
    return LensCamera(camera_of(rigid(pose[:, :3], pose[:, 3]), K, (camera.width, camera.height)), lens)


def colmap_pose(viewmat: NDArray[np.float64]) -> Any:
    """A world-to-camera matrix ``[4, 4]`` as a rigid motion of pycolmap."""
    pycolmap = pycolmap_module()
    return pycolmap.Rigid3d(pycolmap.Rotation3d(np.ascontiguousarray(viewmat[:3, :3])), viewmat[:3, 3])


def guessed_camera(lens: LensModel, number: int, size: tuple[int, int], degrees: float) -> Any:
    """A camera of pycolmap without distortion whose picture spans ``degrees`` across its longer side."""
    half = math.radians(degrees) / 2
    focal = max(size) / 2 / (half if lens == "fisheye" else math.tan(half))
    camera = pycolmap_module().Camera.create_from_model_name(number, MODELS[lens], focal, *size)
    camera.has_prior_focal_length = True
    return camera


def field_of_view(lens: LensModel, focal: float, size: tuple[int, int]) -> float:
    """Degrees that the longer side spans of a picture without distortion of this focal length in pixels."""
    half = max(size) / 2 / focal
    return 2 * math.degrees(half if lens == "fisheye" else math.atan(half))
