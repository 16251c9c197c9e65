# SPDX-License-Identifier: Apache-2.0
"""What the header of a picture states: its size, its orientation, and the focal length (Exif 2.32, CIPA DC-008)."""

import math
import re
import warnings
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from structgstream.data.images import stored_picture
from structgstream.errors import CaptureError, MissingExtraError

if TYPE_CHECKING:
    from PIL.ImageFile import ImageFile

MAX_SERIES = 8  # of names that differ by more than numbers, of which one picture is looked at


def picture_size(path: Path) -> tuple[int, int]:
    """Width and height of the stored pixels; other files than PNG and JPEG are decoded.

    Raises:
        CaptureError: the file cannot be read or is not a picture.
        MissingExtraError: Pillow is not installed.
    """
    with _opened(path) as picture:
        if picture is not None and picture.format in ("PNG", "JPEG", "MPO"):
            return picture.size
    return stored_picture(path).shape[1::-1]


def check_one_series(camera: str, files: Iterable[Path]) -> None:
    """Check that a camera's pictures whose names differ by more than numbers have one size, unlike thumbnails.

    Raises:
        CaptureError: they have not, or one of them cannot be read.
    """
    firsts: dict[str, Path] = {}
    for file in files:
        firsts.setdefault(re.sub(r"\d+", "0", file.stem), file)
    series = [*firsts.values()][:MAX_SERIES] if len(firsts) > 1 else []
    sizes = {picture_size(file): file for file in series}
    if len(sizes) > 1:
        (one, first), (other, second) = [*sizes.items()][:2]
        raise CaptureError(
            f"The pictures of camera {camera!r} in {first.parent} are of several sizes, {first.name} of "
            f"{one[0]}x{one[1]} pixels and {second.name} of {other[0]}x{other[1]}; expected one series: move the other "
            "one out of the folder."
        )


@contextmanager
def _opened(path: Path) -> Iterator["ImageFile | None"]:
    """The picture with its header read; None if Pillow does not read it.

    Raises:
        CaptureError: the file cannot be read.
        MissingExtraError: Pillow is not installed.
    """
    try:
        from PIL import Image, UnidentifiedImageError
    except ImportError:
        raise MissingExtraError("Pillow", "capture") from None
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of damaged metadata; what is needed of them is checked where it is read
            picture = Image.open(path)
    except (UnidentifiedImageError, SyntaxError, ValueError, Image.DecompressionBombError):
        yield None
        return
    except OSError as error:
        if error.errno is not None:
            raise CaptureError(f"The picture {path} cannot be read ({error.strerror}); restore it.") from None
        yield None
        return
    with picture:
        yield picture


ORIENTATION, EXIF_IFD = 0x0112, 0x8769
FOCAL_LENGTH, FOCAL_35MM = 0x920A, 0xA405
PLANE_RESOLUTION, PLANE_UNIT, PIXELS_ACROSS, PIXELS_DOWN = 0xA20E, 0xA210, 0xA002, 0xA003
MILLIMETRES = {2: 25.4, 3: 10.0, 4: 1.0, 5: 1e-3}
"""In the unit of the resolution of the focal plane: inch, and by common extension of TIFF centimetre, mm and µm."""
DIAGONAL_35MM = math.hypot(36.0, 24.0)
AGREE = 0.12
"""Share by which two focal lengths may differ: whole millimetres of 35 mm film are up to 3 % off, crops more."""
MIN_FOCAL_SHARE, MAX_FOCAL_SHARE = 0.2, 20.0
"""Focal lengths of lenses, relative to the longer side."""


@dataclass(frozen=True)
class StatedOptics:
    """Focal length and orientation of a picture by its header.

    Args:
        focal_pixels: focal length in pixels of the picture; None if not stated.
        orientation: how the stored picture is to be turned (1 to 8; 1 is not at all).
    """

    focal_pixels: float | None
    orientation: int


def read_exif(path: Path) -> StatedOptics:
    """Focal length and orientation by a picture's header.

    The focal length comes from that of the lens and the resolution of its focal plane, as far as the equivalent one of
    35 mm film does not contradict it; else from that one, which is taken as of the diagonal.

    Files without such a header, or with a damaged one, state nothing; whether the picture can be decoded is not looked
    at.

    Raises:
        CaptureError: the file cannot be read.
        MissingExtraError: Pillow is not installed.
    """
    with _opened(path) as picture:
        if picture is None:
            return StatedOptics(None, 1)
        try:
            size, tags = picture.size, picture.getexif()
            detail: Mapping[int, Any] = tags.get_ifd(EXIF_IFD)
            orientation = tags.get(ORIENTATION, 1)
        except (OSError, SyntaxError, ValueError):
            return StatedOptics(None, 1)
    whole = orientation if isinstance(orientation, int) and 1 <= orientation <= 8 else 1
    return StatedOptics(_focal_pixels(detail, size), whole)


def _focal_pixels(tags: Mapping[int, Any], size: tuple[int, int]) -> float | None:
    film, plane = _by_film(tags, size), _by_plane(tags, size)
    likely = [
        focal for focal in (plane, film) if focal is not None and MIN_FOCAL_SHARE < focal / max(size) < MAX_FOCAL_SHARE
    ]
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
