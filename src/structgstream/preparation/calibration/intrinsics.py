# SPDX-License-Identifier: Apache-2.0
"""Intrinsics to begin with."""

import math
from typing import Any

from structgstream.preparation.calibration.colmap import MODELS, LensModel, pycolmap_module


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
