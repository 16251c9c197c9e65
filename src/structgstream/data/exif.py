# SPDX-License-Identifier: Apache-2.0
"""What a picture's file says of the lens, by Exif 2.32 (CIPA DC-008): the focal length, and how the camera was held."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from structgstream.errors import CaptureError, MissingExtraError

ORIENTATION, EXIF_IFD = 0x0112, 0x8769
FOCAL_LENGTH, FOCAL_35MM = 0x920A, 0xA405
PLANE_RESOLUTION, PLANE_UNIT, PIXELS_ACROSS, PIXELS_DOWN = 0xA20E, 0xA210, 0xA002, 0xA003
MILLIMETRES = {2: 25.4, 3: 10.0, 4: 1.0, 5: 1e-3}
"""In the unit of the resolution of the focal plane: inch, and by common extension of TIFF centimetre, mm and µm."""
DIAGONAL_35MM = math.hypot(36.0, 24.0)
AGREE = 0.12
"""Share by which two focal lengths may differ: whole millimetres of 35 mm film are up to 3 % off, crops more."""
LEAST, MOST = 0.2, 20.0
"""Focal lengths over the longer side that lenses have."""


@dataclass(frozen=True)
class Stated:
    """What a file states.

    Args:
        focal_pixels: focal length in pixels of the picture; None where it does not say.
        orientation: how the stored picture is to be turned (1 to 8; 1 is not at all).
    """

    focal_pixels: float | None
    orientation: int


def read_exif(path: Path) -> Stated:
    """What a picture states; only its header is read.

    The focal length comes from that of the lens and the resolution of its focal plane, as far as the equivalent one of
    35 mm film does not contradict it; else from that one, which is taken as of the diagonal.

    Files without such a header, or with a damaged one, state nothing; whether the picture can be decoded is not looked
    at.

    Raises:
        CaptureError: the file cannot be read.
        MissingExtraError: Pillow is not installed.
    """
    try:
        from PIL import Image, UnidentifiedImageError
    except ImportError:
        raise MissingExtraError("Pillow", "capture") from None
    try:
        with Image.open(path) as picture:
            size, tags = picture.size, picture.getexif()
            detail: Mapping[int, Any] = tags.get_ifd(EXIF_IFD)
            orientation = tags.get(ORIENTATION, 1)
    except (UnidentifiedImageError, SyntaxError, ValueError):
        return Stated(None, 1)
    except OSError as error:
        raise CaptureError(f"The picture {path} cannot be read ({error.strerror}); restore it.") from None
    whole = orientation if isinstance(orientation, int) and 1 <= orientation <= 8 else 1
    return Stated(_focal_pixels(detail, size), whole)


def _focal_pixels(tags: Mapping[int, Any], size: tuple[int, int]) -> float | None:
    film, plane = _by_film(tags, size), _by_plane(tags, size)
    likely = [focal for focal in (plane, film) if focal is not None and LEAST < focal / max(size) < MOST]
    if len(likely) == 2 and abs(likely[0] / likely[1] - 1) > AGREE:
        return film
    return likely[0] if likely else None


def _by_film(tags: Mapping[int, Any], size: tuple[int, int]) -> float | None:
    equivalent = _number(tags.get(FOCAL_35MM))
    return None if equivalent is None else equivalent * math.hypot(*size) / DIAGONAL_35MM


def _by_plane(tags: Mapping[int, Any], size: tuple[int, int]) -> float | None:
    """By the resolution of the sensor for the picture as it was taken, which may have been reduced since."""
    length, resolution = _number(tags.get(FOCAL_LENGTH)), _number(tags.get(PLANE_RESOLUTION))
    unit = MILLIMETRES.get(tags.get(PLANE_UNIT, 2))
    if length is None or resolution is None or unit is None:
        return None
    across, down = _number(tags.get(PIXELS_ACROSS)), _number(tags.get(PIXELS_DOWN))
    if across is not None and down is not None:  # The longer sides: what turns a picture seldom turns its tags.
        return length * resolution / unit * max(size) / max(across, down)
    return length * resolution / unit * size[0] / (across or size[0])


def _number(value: object) -> float | None:
    """A positive number; None for anything else, as tags of 0 and 0/0 that mean unknown."""
    try:
        number = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if 0 < number < math.inf else None
