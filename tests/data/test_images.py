# SPDX-License-Identifier: Apache-2.0
import sys
from pathlib import Path

import numpy as np
import pytest

from structgstream.data.images import ImageSource, common_pictures
from structgstream.errors import CalibrationError, CaptureError, MissingExtraError
from tests.support.captures import all_numbers, picture, small_rig, write_picture
from tests.support.drawn import pixels_of


@pytest.fixture
def source(tmp_path: Path) -> ImageSource:
    rig = small_rig(3)
    files = {name: tuple(tmp_path / name / f"{frame}.jpg" for frame in range(5)) for name in rig}
    for number, name in enumerate(rig):
        for frame, path in enumerate(files[name]):
            write_picture(path, picture(number, frame))
    return ImageSource("take", rig, 25.0, files)


def test_frames_come_in_order_with_time_and_every_camera(source: ImageSource) -> None:
    frames = list(source.frames())
    assert all_numbers(frames) == [[(camera, frame) for camera in range(3)] for frame in range(5)]
    assert [frame.index for frame in frames] == [0, 1, 2, 3, 4]
    assert [frame.pts_seconds for frame in frames] == pytest.approx([0, 0.04, 0.08, 0.12, 0.16])
    assert list(frames[0].images) == list(source.rig)
    assert frames[0].images["cam00"].dtype == np.uint8


def test_frames_start_anywhere_and_again(source: ImageSource) -> None:
    assert [frame.index for frame in source.frames(3)] == [3, 4]
    assert all_numbers(source.frames(3)) == all_numbers(list(source.frames())[3:])
    assert list(source.frames(5)) == []


def test_channels_are_red_green_blue(source: ImageSource, tmp_path: Path) -> None:
    orange = np.full((48, 64, 3), (250, 120, 10), np.uint8)
    write_picture(tmp_path / "cam00" / "0.jpg", orange)
    image = next(source.frames()).images["cam00"]
    np.testing.assert_allclose(image.mean(axis=(0, 1)), (250, 120, 10), atol=3)


def test_an_orientation_tag_does_not_turn_the_calibrated_pixels(source: ImageSource, tmp_path: Path) -> None:
    path = tmp_path / "cam00" / "0.jpg"
    data = path.read_bytes()
    turned = b"II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0\x06\0\0\0\0\0\0\0"  # TIFF: orientation 6
    exif = b"Exif\0\0" + turned
    path.write_bytes(data[:2] + b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif + data[2:])
    assert pixels_of(path).shape == (64, 48, 3)
    assert next(source.frames()).images["cam00"].shape == (48, 64, 3)


def test_a_picture_of_another_size_names_file_and_sizes(source: ImageSource, tmp_path: Path) -> None:
    write_picture(tmp_path / "cam01" / "2.jpg", picture(1, 2, width=32, height=24))
    with pytest.raises(CalibrationError, match=r"cam01/2\.jpg has 32x24 pixels.*64x48"):
        list(source.frames())


@pytest.mark.parametrize("damage", ["cut", "empty", "junk", "gone"])
def test_an_unreadable_picture_is_named_after_the_frames_before_it(
    source: ImageSource, tmp_path: Path, damage: str
) -> None:
    path = tmp_path / "cam02" / "3.jpg"
    data = path.read_bytes()
    if damage == "gone":
        path.unlink()
    else:
        path.write_bytes({"cut": data[: len(data) // 2], "empty": b"", "junk": b"\xff\xd8hello\xff\xd9"}[damage])
    frames = source.frames()
    assert [next(frames).index for _ in range(3)] == [0, 1, 2]
    with pytest.raises(CaptureError, match=r"cam02/3\.jpg cannot be (decoded|read)"):
        next(frames)


def test_the_extra_is_named_when_opencv_is_absent(source: ImageSource, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "cv2", None)
    with pytest.raises(MissingExtraError, match=r"structgstream\[capture\]"):
        next(source.frames())


def test_pictures_are_matched_by_name_not_by_count() -> None:
    files = {
        "a": {name: Path(f"a/{name}.png") for name in ("8", "9", "10")},
        "b": {name: Path(f"b/{name}.png") for name in ("9", "10", "11")},
    }
    common = common_pictures(files, where=Path("take"))
    assert common.instants == ("9", "10")
    assert common.files == {name: (Path(f"{name}/9.png"), Path(f"{name}/10.png")) for name in "ab"}
    del files["a"]["9"]
    common = common_pictures({**files, "b": {**files["b"], "8": Path("b/8.png")}}, where=Path("take"))
    assert common.files["a"] == (Path("a/8.png"), None, Path("a/10.png"))
