# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

import cv2
import numpy as np
import pytest

from structgstream.data.images import picture_size
from structgstream.errors import CaptureError


@pytest.mark.parametrize("suffix", ["png", "jpg", "bmp", "webp", "tif"])
@pytest.mark.parametrize("size", [(1, 1), (37, 20), (640, 481)])
def test_the_size_of_stored_pixels(tmp_path: Path, suffix: str, size: tuple[int, int]) -> None:
    file = tmp_path / f"picture.{suffix}"
    assert cv2.imwrite(str(file), np.zeros((size[1], size[0], 3), np.uint8))
    assert picture_size(file) == size


@pytest.mark.parametrize("progressive", [0, 1])
def test_jpeg_of_a_phone(tmp_path: Path, progressive: int) -> None:
    """Large tables of metadata stand before the frame's header; a rotation tag turns nothing."""
    coded = cv2.imencode(".jpg", np.zeros((30, 50, 3), np.uint8), [cv2.IMWRITE_JPEG_PROGRESSIVE, progressive])[1]
    exif = b"Exif\0\0MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x06\0\0\0\0\0\0" + bytes(5000)
    data = coded.tobytes()
    (tmp_path / "a.jpg").write_bytes(data[:2] + b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif + data[2:])
    assert picture_size(tmp_path / "a.jpg") == (50, 30)


@pytest.mark.parametrize("content", [b"", b"junk", b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n"])
def test_what_is_no_picture(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "a.jpg").write_bytes(content)
    with pytest.raises(CaptureError, match=r"a\.jpg cannot be decoded"):
        picture_size(tmp_path / "a.jpg")
    with pytest.raises(CaptureError, match=r"b\.jpg cannot be read"):
        picture_size(tmp_path / "b.jpg")
