# SPDX-License-Identifier: Apache-2.0
"""Focal lengths and orientations that made pictures state."""

import math
import sys
from pathlib import Path
from typing import Any

import pytest
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from structgstream.data.images import StatedOptics, read_exif
from structgstream.errors import CaptureError, MissingExtraError

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


def test_pictures_that_were_reduced(tmp_path: Path) -> None:
    tags = {FOCAL: IFDRational(5), RESOLUTION: IFDRational(320), UNIT: 4, ACROSS: 1600}
    assert read_exif(written(tmp_path / "a.jpg", tags)).focal_pixels == pytest.approx(400)


def test_pictures_that_were_turned_without_their_tags(tmp_path: Path) -> None:
    """As ``jpegtran -rotate 90`` does, here of a picture that was reduced before."""
    tags = {FOCAL: IFDRational(5), RESOLUTION: IFDRational(320), UNIT: 4, ACROSS: 1600, DOWN: 1200}
    assert read_exif(written(tmp_path / "a.jpg", tags, size=(300, 400))).focal_pixels == pytest.approx(400)
    assert read_exif(written(tmp_path / "b.jpg", tags)).focal_pixels == pytest.approx(400)


def test_of_two_that_contradict_each_other_the_one_of_film_counts(tmp_path: Path) -> None:
    """The resolution of the focal plane is often that of another size; where both agree it is the exact one."""
    film = 26 * 500 / math.hypot(36, 24)
    tags = {FOCAL: IFDRational(5), UNIT: 4, FILM: 26}
    wrong = written(tmp_path / "a.jpg", {**tags, RESOLUTION: IFDRational(320)})
    right = written(tmp_path / "b.jpg", {**tags, RESOLUTION: IFDRational(62)})
    assert read_exif(wrong).focal_pixels == pytest.approx(film)
    assert read_exif(right).focal_pixels == pytest.approx(310)


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
