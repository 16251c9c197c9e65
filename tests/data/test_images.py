# SPDX-License-Identifier: Apache-2.0
"""Focal lengths and orientations that made pictures state."""

import math
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from structgstream.data.images import ImageSource, StatedOptics, picture_size, read_exif
from structgstream.errors import CalibrationError, CaptureError, MissingExtraError
from tests.support.captures import all_numbers, picture, small_rig, write_picture, write_pictures


@pytest.fixture
def source(tmp_path: Path) -> ImageSource:
    rig = small_rig(3)
    write_pictures(tmp_path, "CAM/FRAME.jpg", rig, frames=5)
    files = {name: tuple(tmp_path / name / f"{frame:06d}.jpg" for frame in range(5)) for name in rig}
    return ImageSource("take", rig, 25.0, files)


def test_frames_come_in_order_with_time_and_every_camera(source: ImageSource) -> None:
    frames = list(source.frames())
    assert all_numbers(frames) == [[(camera, frame) for camera in range(3)] for frame in range(5)]
    assert [frame.index for frame in frames] == [0, 1, 2, 3, 4]
    assert [frame.pts_seconds for frame in frames] == pytest.approx([0, 0.04, 0.08, 0.12, 0.16])
    assert list(frames[0].images) == list(source.rig)
    assert frames[0].images["cam00"].dtype == np.uint8


def test_channels_are_red_green_blue(source: ImageSource, tmp_path: Path) -> None:
    orange = np.full((48, 64, 3), (250, 120, 10), np.uint8)
    write_picture(tmp_path / "cam00" / "000000.jpg", orange)
    image = next(source.frames()).images["cam00"]
    np.testing.assert_allclose(image.mean(axis=(0, 1)), (250, 120, 10), atol=3)


def test_a_picture_of_another_size_names_file_and_sizes(source: ImageSource, tmp_path: Path) -> None:
    write_picture(tmp_path / "cam01" / "000002.jpg", picture(1, 2, width=32, height=24))
    with pytest.raises(CalibrationError, match=r"cam01/000002\.jpg has 32x24 pixels.*64x48"):
        list(source.frames())


@pytest.mark.parametrize("damage", ["cut", "empty", "junk", "gone"])
def test_an_unreadable_picture_is_named_after_the_frames_before_it(
    source: ImageSource, tmp_path: Path, damage: str
) -> None:
    path = tmp_path / "cam02" / "000003.jpg"
    data = path.read_bytes()
    if damage == "gone":
        path.unlink()
    else:
        path.write_bytes({"cut": data[: len(data) // 2], "empty": b"", "junk": b"\xff\xd8hello\xff\xd9"}[damage])
    frames = source.frames()
    assert [next(frames).index for _ in range(3)] == [0, 1, 2]
    with pytest.raises(CaptureError, match=r"cam02/000003\.jpg cannot be (decoded|read)"):
        next(frames)


def test_the_extra_is_named_when_opencv_is_absent(source: ImageSource, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "cv2", None)
    with pytest.raises(MissingExtraError, match=r"structgstream\[capture\]"):
        next(source.frames())


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


FOCAL, FILM, RESOLUTION, UNIT, ACROSS, DOWN = 0x920A, 0xA405, 0xA20E, 0xA210, 0xA002, 0xA003


def written(path: Path, tags: dict[int, Any], *, size: tuple[int, int] = (400, 300), orientation: int = 1) -> Path:
    exif = Image.Exif()
    exif[0x0112] = orientation
    exif.get_ifd(0x8769).update(tags)
    Image.new("RGB", size).save(path, exif=exif)
    return path


@pytest.mark.parametrize("suffix", ["jpg", "png", "webp"])
def test_a_focal_length_of_35_mm_film(tmp_path: Path, suffix: str) -> None:
    """26 mm on a diagonal of 43.27 mm, which is 500 pixels."""
    stated = read_exif(written(tmp_path / f"a.{suffix}", {FILM: 26}))
    assert stated.focal_pixels == pytest.approx(26 * 500 / math.hypot(36, 24))
    assert stated.orientation == 1


@pytest.mark.parametrize(
    ("unit", "resolution"), [(2, 25.4 * 80), (3, 800), (4, 80), (5, IFDRational(80, 1000)), (None, 25.4 * 80)]
)
def test_a_focal_length_and_the_pitch_of_the_sensor(tmp_path: Path, unit: int | None, resolution: Any) -> None:
    """5 mm at 80 pixels a millimetre; the unit is the inch where it is not stated."""
    tags = {FOCAL: IFDRational(5), RESOLUTION: IFDRational(resolution)} | ({} if unit is None else {UNIT: unit})
    assert read_exif(written(tmp_path / "a.jpg", tags)).focal_pixels == pytest.approx(400, rel=1e-3)


LARGE = {FOCAL: IFDRational(5), RESOLUTION: IFDRational(320), UNIT: 4}  # of the sensor's 1600 x 1200 pixels


@pytest.mark.parametrize(
    ("tags", "size", "focal"),
    [
        pytest.param({**LARGE, ACROSS: 1600}, (400, 300), 400, id="reduced"),
        pytest.param({**LARGE, ACROSS: 1600, DOWN: 1200}, (400, 300), 400, id="reduced, both sides stated"),
        pytest.param({**LARGE, ACROSS: 1600, DOWN: 1200}, (300, 400), 400, id="then turned by jpegtran, not its tags"),
        # The resolution is often that of another size; where both agree it is the exact one.
        pytest.param({**LARGE, FILM: 26}, (400, 300), 26 * 500 / math.hypot(36, 24), id="contradicted by that of film"),
        pytest.param({**LARGE, RESOLUTION: IFDRational(62), FILM: 26}, (400, 300), 310, id="close to that of film"),
    ],
)
def test_a_focal_length_of_a_picture_of_another_size(
    tmp_path: Path, tags: dict[int, Any], size: tuple[int, int], focal: float
) -> None:
    assert read_exif(written(tmp_path / "a.jpg", tags, size=size)).focal_pixels == pytest.approx(focal)


@pytest.mark.parametrize(
    "tags", [{}, {FILM: 0}, {FOCAL: IFDRational(5)}, {FOCAL: IFDRational(0, 0), RESOLUTION: IFDRational(80), UNIT: 4},
             {FOCAL: IFDRational(5), RESOLUTION: IFDRational(80), UNIT: 1}, {FILM: 60000}]
)  # fmt: skip
def test_what_says_nothing(tmp_path: Path, tags: dict[int, Any]) -> None:
    assert read_exif(written(tmp_path / "a.jpg", tags)).focal_pixels is None


@pytest.mark.parametrize(("stated", "taken"), [(6, 6), (8, 8), (0, 1), (9, 1)])
def test_orientation(tmp_path: Path, stated: int, taken: int) -> None:
    assert read_exif(written(tmp_path / "a.jpg", {}, orientation=stated)).orientation == taken


def test_files_that_cannot_be_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.jpg").write_bytes(b"nothing")
    assert read_exif(tmp_path / "a.jpg") == StatedOptics(None, 1)
    with pytest.raises(CaptureError, match=r"b\.jpg cannot be read"):
        read_exif(tmp_path / "b.jpg")
    monkeypatch.setitem(sys.modules, "PIL", None)
    with pytest.raises(MissingExtraError, match="Pillow"):
        read_exif(tmp_path / "a.jpg")
