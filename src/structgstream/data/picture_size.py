# SPDX-License-Identifier: Apache-2.0
"""The size of a picture without decoding it, as a capture may have hundreds of cameras."""

import re
import struct
from collections.abc import Iterable
from pathlib import Path

from structgstream.data.images import stored_picture
from structgstream.errors import CaptureError

PNG = b"\x89PNG\r\n\x1a\n"
MAX_SERIES = 8  # of names that differ by more than numbers, of which one picture is looked at
START_OF_FRAME = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}  # ITU-T T.81, table B.1


def picture_size(path: Path) -> tuple[int, int]:
    """Width and height of the stored pixels.

    Raises:
        CaptureError: the file cannot be read or is not a picture.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise CaptureError(f"The picture {path} cannot be read ({error.strerror}); restore it.") from None
    size = None
    if data[:8] == PNG and len(data) >= 24:
        size = struct.unpack(">II", data[16:24])
    elif data[:2] == b"\xff\xd8":
        size = _jpeg_size(data)
    return size or stored_picture(path).shape[1::-1]


def check_one_series(camera: str, files: Iterable[Path]) -> None:
    """That those of a camera's pictures whose names differ by more than numbers have one size, unlike thumbnails.

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


def _jpeg_size(data: bytes) -> tuple[int, int] | None:
    at = 2
    while at + 9 <= len(data) and data[at] == 0xFF:
        marker, length = struct.unpack_from(">BH", data, at + 1)
        if marker in START_OF_FRAME:
            height, width = struct.unpack_from(">HH", data, at + 5)
            return width, height
        at += 2 + length
    return None
