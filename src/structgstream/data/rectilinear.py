# SPDX-License-Identifier: Apache-2.0
"""Which pinhole camera the pictures of a lens are undistorted for.

By default it has the largest field of view that the lens fills, up to :data:`WIDEST_DEGREES`.
"""

import math
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray

from structgstream.cameras import Camera
from structgstream.data.arrays import Floats
from structgstream.data.lenses import LensCamera, Pinhole
from structgstream.errors import CalibrationError, ConfigError

WIDEST_DEGREES = 110.0
"""Across the longer side. A rectilinear picture is stretched 3 times at the edge of 110 degrees, 15 times of 150."""
BORDER_SAMPLES = 129
SLACK_PIXELS = 0.01  # by which a sampled border may leave the picture


def rectilinear(filmed: LensCamera, *, degrees: float | None = None, size: tuple[int, int] | None = None) -> Camera:
    """The pinhole that pictures of a lens can be resampled for, with square pixels.

    Args:
        filmed: the camera with its lens; without distortion it is returned unchanged, unless ``degrees`` or ``size``
            is given.
        degrees: field of view across the picture's width, around the optical axis; None for the largest that the lens
            fills, up to :data:`WIDEST_DEGREES` across the longer side.
        size: width and height of the pictures, pixels; None for those of the lens.

    Raises:
        ConfigError: a field of view of 175 degrees or more, or a size that is not positive.
        CalibrationError: a lens model that is invertible nowhere in its picture.
    """
    width, height = (filmed.camera.width, filmed.camera.height) if size is None else size
    if min(width, height) < 1:
        raise ConfigError(f"A picture of {width}x{height} pixels cannot be made; give a positive width and height.")
    if degrees is None and isinstance(filmed.lens, Pinhole):
        return filmed.camera.resized(width, height)
    if degrees is not None:
        check_field_of_view(degrees)
        focal = width / 2 / math.tan(math.radians(degrees) / 2)
        middle = np.zeros(2)
    else:
        low, high = _filled(filmed)
        middle = (low + high) / 2
        least = max(width, height) / 2 / math.tan(math.radians(WIDEST_DEGREES) / 2)
        # The picture's outermost pixel centres lie on the border of what is filled.
        focal = float(max((np.array([width - 1, height - 1]) / (high - low)).max(), least))
    cx, cy = width / 2 - focal * middle[0], height / 2 - focal * middle[1]
    K = torch.tensor([[focal, 0, cx], [0, focal, cy], [0, 0, 1]], dtype=torch.float64)
    return replace(filmed.camera, K=K, width=width, height=height)


def check_field_of_view(degrees: float) -> None:
    """
    Raises:
        ConfigError: no angle across a plane.
    """
    if not 0 < degrees < 175:
        raise ConfigError(f"A plane cannot show {degrees:g} degrees; give a field of view of less than 175.")


def shows(filmed: LensCamera, normalised: Floats) -> NDArray[np.bool_]:
    """Which directions a lens has in its picture, within the outermost pixel centres.

    Args:
        filmed: the camera with its lens.
        normalised: ``[..., 2]``, x and y at depth 1.

    Returns:
        ``[...]``; False where the lens sees no such direction.
    """
    pixels = filmed.to_pixels(normalised)  # NaN there, which lies on no side
    most = np.array([filmed.camera.width, filmed.camera.height]) - 0.5 + SLACK_PIXELS
    return np.all((pixels >= 0.5 - SLACK_PIXELS) & (pixels <= most), axis=-1)


def _filled(filmed: LensCamera) -> tuple[Floats, Floats]:
    """Two corners, normalised, of a rectangle around the axis that the lens fills."""
    width, height = filmed.camera.width, filmed.camera.height
    across, down = np.linspace(0.5, width - 0.5, BORDER_SAMPLES), np.linspace(0.5, height - 0.5, BORDER_SAMPLES)
    bounds = []
    for axis, along, edge in ((0, down, width), (1, across, height)):
        for at, worst in ((0.5, np.nanmax), (edge - 0.5, np.nanmin)):
            pixels = np.stack([np.full_like(along, at), along] if axis == 0 else [along, np.full_like(along, at)], -1)
            seen = filmed.to_normalized(pixels)[:, axis]  # NaN where the lens sees no such thing: no bound
            bounds.append(worst(seen) if np.isfinite(seen).any() else math.copysign(math.inf, at - 1))
    most = min(filmed.lens.reach, math.tan(math.radians(WIDEST_DEGREES) / 2))
    low, high = np.maximum(bounds[0::2], -most), np.minimum(bounds[1::2], most)
    if not ((low < 0).all() and (high > 0).all()):
        raise CalibrationError(
            "The lens does not fill a picture around its axis: principal point or distortion belong to another "
            "picture; expected the calibration of these pictures."
        )
    # Corners may lie beyond the reach of the lens, or outside of its picture, although the sides do not.
    for _ in range(400):
        if shows(filmed, _border(low, high)).all():
            return low, high
        low, high = low * 0.99, high * 0.99
    raise CalibrationError(
        "The lens model folds at its axis, so that nothing can be undistorted; check the order of the coefficients."
    )


def _border(low: Floats, high: Floats) -> Floats:
    along = np.linspace(0, 1, BORDER_SAMPLES)[:, None]
    corners = np.array([low, [high[0], low[1]], high, [low[0], high[1]]])
    return np.concatenate([a + along * (b - a) for a, b in zip(corners, np.roll(corners, -1, axis=0))])
