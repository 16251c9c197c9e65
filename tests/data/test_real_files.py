# SPDX-License-Identifier: Apache-2.0
"""Pictures and videos as cameras and recorders write them."""

import logging
import struct
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest
from PIL import Image, ImageCms

from structgstream.data.calibration import Calibration, PosedCamera
from structgstream.data.camera_files import files_of
from structgstream.data.images import (
    ImageSource,
    common_pictures,
    picture_size,
    read_picture,
    read_picture_and_mask,
    turned,
)
from structgstream.data.posed_capture import _orientation
from structgstream.data.timeline import picture_slots
from structgstream.data.video import VideoSource, high_range_to_srgb, synchronised
from structgstream.data.video_index import BT2020, HLG, PQ, scan_videos
from structgstream.errors import CalibrationError, CaptureError
from structgstream.preparation.footage import find_footage
from tests.support.captures import small_rig

RIG = small_rig(3)
OPTIONS = {"g": "4", "sc_threshold": "0", "lag-in-frames": "0"}


def encode(
    path: Path,
    *,
    skip: int = 0,
    frames: int = 12,
    codec: str = "libx264",
    thumbnail: bool = False,
    bf: int = 0,
    first: int = 0,
) -> None:
    """Pictures whose grey is their number times 16, in groups of four, without the first ``skip`` packets.

    ``first`` is the time stamp of the first picture, in frames.
    """
    with av.open(str(path), "w") as container:
        small: Any = container.add_stream("mjpeg", rate=30) if thumbnail else None
        stream: Any = container.add_stream(codec, rate=30, options=OPTIONS | {"bf": str(bf)})
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        if thumbnail:
            small.width, small.height, small.pix_fmt = 32, 24, "yuvj420p"
            container.mux(small.encode(av.VideoFrame.from_ndarray(np.zeros((24, 32, 3), np.uint8), format="rgb24")))
            container.mux(small.encode())
        packets = []
        for number in range(frames):
            frame = av.VideoFrame.from_ndarray(np.full((48, 64, 3), 16 * number, np.uint8), format="rgb24")
            frame.pts, frame.time_base = first + number, Fraction(1, 30)
            packets += stream.encode(frame)
        for packet in [*packets, *stream.encode()][skip:]:
            container.mux(packet)


def numbers(source: Any, start: int = 0) -> list[int | None]:
    return [
        round(float(frame.images["cam01"].mean()) / 16) if "cam01" in frame.images else None
        for frame in source.frames(start)
    ]


def videos(folder: Path, ending: str, *, codec: str = "libx264", **odd: Any) -> dict[str, Path]:
    """A video of each camera; that of ``cam01`` is written with ``odd``."""
    files = {name: folder / f"{name}{ending}" for name in RIG}
    for name, file in files.items():
        encode(file, codec=codec, **(odd if name == "cam01" else {}))
    return files


def take(files: dict[str, Path]) -> VideoSource:
    return synchronised(scan_videos(files), RIG, where=Path("take"))


@pytest.mark.parametrize(("ending", "codec"), [(".mkv", "libx264"), (".ts", "libx264"), (".webm", "libvpx-vp9")])
def test_a_video_that_begins_within_a_group_has_the_frames_that_decode(tmp_path: Path, ending: str, codec: str) -> None:
    source = take(videos(tmp_path, ending, codec=codec, skip=2))
    assert len(source.tracks["cam01"].stamps) == 8, "what counts is what decodes"
    assert numbers(source) == [4, 5, 6, 7, 8, 9, 10, 11]
    assert numbers(source, 5) == [9, 10, 11], "a resumed run has the same frames"


@pytest.mark.parametrize("skip", [0, 2])
def test_a_transport_stream_among_other_containers_begins_at_its_first_picture(tmp_path: Path, skip: int) -> None:
    files = videos(tmp_path, ".mp4") | {"cam01": tmp_path / "cam01.ts"}
    encode(files["cam01"], first=42, skip=skip)  # at 1.4 s, as FFmpeg writes it
    assert numbers(take(files)) == ([*range(12)] if not skip else [4, 5, 6, 7, 8, 9, 10, 11])


def test_transport_streams_alone_keep_their_stamps(tmp_path: Path) -> None:
    assert numbers(take(videos(tmp_path, ".ts", first=2))) == [*range(10)], "cam01 began 2 frames later"


def test_lost_packets_of_a_transport_stream_are_an_absence_up_to_the_next_key_frame(tmp_path: Path) -> None:
    files = videos(tmp_path, ".ts")
    content = files["cam01"].read_bytes()
    packets = [content[at : at + 188] for at in range(0, len(content), 188)]
    files["cam01"].write_bytes(b"".join(packets[: len(packets) // 2] + packets[len(packets) // 2 + 1 :]))
    found = numbers(take(files))
    assert found[-1] == 11
    assert all(number in (place, None) for place, number in enumerate(found))


def test_the_video_is_read_and_not_its_thumbnail(tmp_path: Path) -> None:
    files = videos(tmp_path, ".mp4", thumbnail=True)
    track = scan_videos(files)["cam01"]
    assert (track.width, track.height, len(track.stamps)) == (64, 48, 12)


def test_avi_is_read(tmp_path: Path) -> None:
    assert numbers(take(videos(tmp_path, ".avi", codec="mpeg4")))[3] == 3


def test_avi_with_b_frames_has_all_of_them_in_order(tmp_path: Path) -> None:
    source = take(videos(tmp_path, ".avi", bf=2))
    assert numbers(source) == list(range(12))
    assert numbers(source, 6) == list(range(6, 12))


@pytest.mark.parametrize(
    ("ending", "codec", "pixels"),
    [(".mkv", "ffv1", "bgra"), (".mov", "prores_ks", "yuva444p10le"), (".webm", "libvpx-vp9", "yuva420p")],
)
def test_what_alpha_of_a_video_hides_does_not_count(tmp_path: Path, ending: str, codec: str, pixels: str) -> None:
    shown = np.full((48, 64, 4), 200, np.uint8)
    shown[..., 3] = 255 * (np.arange(64) >= 32)
    files = {name: tmp_path / f"{name}{ending}" for name in RIG}
    for file in files.values():
        with av.open(str(file), "w") as container:
            stream: Any = container.add_stream(codec, rate=30, options=OPTIONS)
            stream.width, stream.height, stream.pix_fmt = 64, 48, pixels
            if ending == ".webm":
                stream.metadata["alpha_mode"] = "1"
            for number in range(2):
                frame = av.VideoFrame.from_ndarray(shown, format="rgba").reformat(format=pixels)
                frame.pts, frame.time_base = number, Fraction(1, 30)
                container.mux(stream.encode(frame))
            container.mux(stream.encode())
    for frame in take(files).frames():
        assert set(frame.masks) == set(RIG)
        assert not frame.masks["cam01"][:, :30].any()
        assert frame.masks["cam01"][:, 34:].all()


@pytest.mark.parametrize(("transfer", "signal", "expected"), [(HLG, 0.5, 137), (PQ, 0.508, 186), (PQ, 1.0, 255)])
def test_high_dynamic_range_is_converted_to_srgb(transfer: int, signal: float, expected: int) -> None:
    grey = np.full((1, 1, 3), round(signal * 65535), np.uint16)
    np.testing.assert_allclose(high_range_to_srgb(grey, transfer, BT2020), expected, atol=1)


def picture_source(folder: Path, content: np.ndarray[Any, Any]) -> ImageSource:
    files = {}
    for name in RIG:
        cv2.imwrite(str(folder / f"{name}.png"), content)
        files[name] = (folder / f"{name}.png",)
    return ImageSource("take", RIG, 25.0, files)


@pytest.mark.parametrize("bits", [10, 12, 14, 16])
def test_values_of_10_12_and_14_bits_in_16_are_read_at_their_scale(tmp_path: Path, bits: int) -> None:
    stored = np.full((48, 64, 3), 200 << (bits - 8), np.uint16)
    assert (next(picture_source(tmp_path, stored).frames()).images["cam00"] == 200).all()


@pytest.mark.parametrize("orientation", range(1, 9))
def test_pictures_are_turned_as_opencv_turns_them(tmp_path: Path, orientation: int) -> None:
    stored = np.random.default_rng(0).integers(0, 255, (6, 8, 3), np.uint8)
    exif = Image.Exif()
    exif[0x112] = orientation
    Image.fromarray(stored).save(tmp_path / "a.jpg", exif=exif, quality=100)
    shown = cv2.imread(str(tmp_path / "a.jpg"))
    assert shown is not None
    np.testing.assert_array_equal(turned(read_picture(tmp_path / "a.jpg"), orientation), shown[..., ::-1])
    Image.fromarray(stored).save(tmp_path / "a.tif", exif=exif)
    np.testing.assert_array_equal(read_picture(tmp_path / "a.tif"), stored)  # OpenCV turns these whatever is asked


@pytest.mark.parametrize(
    ("orientation", "size", "by_exif", "expected"),
    [(1, (8, 6), None, 1), (6, (6, 8), None, 6), (6, (8, 6), None, 1), (3, (8, 6), True, 3), (3, (8, 6), False, 1),
     (3, (8, 6), None, None)],
)  # fmt: skip
def test_the_calibration_decides_whether_pictures_are_turned(
    tmp_path: Path, orientation: int, size: tuple[int, int], by_exif: bool | None, expected: int | None
) -> None:
    exif = Image.Exif()
    exif[0x112] = orientation
    Image.fromarray(np.zeros((6, 8, 3), np.uint8)).save(tmp_path / "a.jpg", exif=exif)
    posed = PosedCamera("a", np.eye(4), np.eye(3), size)
    calibration = Calibration(tmp_path / "intri.yml", (posed,), turned_by_exif=by_exif)
    if expected is None:
        with pytest.raises(CalibrationError, match="EXIF orientation 3.*upright"):
            _orientation(tmp_path / "a.jpg", posed, calibration)
    else:
        assert _orientation(tmp_path / "a.jpg", posed, calibration) == expected


def test_what_alpha_hides_does_not_count(tmp_path: Path) -> None:
    stored = np.full((48, 64, 4), 255, np.uint8)
    stored[:10, :, 3] = 0
    frame = next(picture_source(tmp_path, stored).frames())
    assert not frame.masks["cam00"][:10].any()
    assert frame.masks["cam00"][10:].all()
    deep = stored.astype(np.uint16) << 4  # 12 bits, of alpha too
    assert next(picture_source(tmp_path, deep).frames()).masks["cam00"][10:].all()


def test_the_fourth_byte_of_a_bmp_hides_nothing(tmp_path: Path) -> None:
    stored = np.full((4, 4, 4), (50, 100, 200, 0), np.uint8)  # blue, green, red, unused
    header = struct.pack("<IiiHHIIiiIIIII", 52, 4, 4, 1, 32, 3, stored.nbytes, 0, 0, 0, 0, 0xFF0000, 0xFF00, 0xFF)
    start = struct.pack("<2sIHHI", b"BM", 14 + len(header) + stored.nbytes, 0, 0, 14 + len(header))
    (tmp_path / "a.bmp").write_bytes(start + header + stored.tobytes())
    picture, mask = read_picture_and_mask(tmp_path / "a.bmp")
    assert mask is None
    assert (picture == (200, 100, 50)).all()


def test_a_jpeg_may_carry_a_video_behind_its_end_but_not_be_cut(tmp_path: Path) -> None:
    content = cv2.imencode(".jpg", np.random.default_rng(0).integers(0, 255, (48, 64, 3), np.uint8))[1].tobytes()
    (tmp_path / "a.jpg").write_bytes(content + bytes(9000))
    assert read_picture(tmp_path / "a.jpg").shape == (48, 64, 3)
    (tmp_path / "b.jpg").write_bytes(content[: len(content) // 2])
    with pytest.raises(CaptureError, match="cut or damaged.; restore it, or move it out") as raised:
        read_picture(tmp_path / "b.jpg")
    assert "delete" not in str(raised.value)


def test_a_tiff_that_holds_a_take_is_refused_but_not_one_with_a_thumbnail(tmp_path: Path) -> None:
    """ImageJ and frame grabbers write stacks."""
    picture, small = (Image.new("RGB", size, (200, 100, 50)) for size in ((64, 48), (16, 12)))
    picture.save(tmp_path / "a.tif", save_all=True, append_images=[picture] * 4)
    with pytest.raises(CaptureError, match="a.tif has several pages of one size, of which the first alone would be"):
        picture_size(tmp_path / "a.tif")
    picture.save(tmp_path / "b.tif", save_all=True, append_images=[small])
    assert picture_size(tmp_path / "b.tif") == (64, 48)


@pytest.mark.parametrize("suffix", ["jpg", "png", "tif", "webp"])
def test_pictures_of_another_color_profile_are_converted_to_srgb(tmp_path: Path, suffix: str) -> None:
    """Phones write Display P3, cameras Adobe RGB; here red and green are exchanged."""
    srgb = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    exchanged = srgb.replace(b"rXYZ", b"....").replace(b"gXYZ", b"rXYZ").replace(b"....", b"gXYZ")
    for profile, color in ((srgb, (200, 100, 50)), (exchanged, (100, 200, 50)), (b"damaged", (200, 100, 50))):
        image = Image.new("RGB", (64, 48), (200, 100, 50))
        image.save(tmp_path / f"a.{suffix}", icc_profile=profile, quality=100)
        np.testing.assert_allclose(read_picture(tmp_path / f"a.{suffix}")[20, 30], color, atol=4)


def test_float_pictures_and_heic_are_refused_for_what_they_are(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.tiff"), np.zeros((48, 64, 3), np.float32))
    with pytest.raises(CaptureError, match="no whole numbers of 8 or 16 bits"):
        read_picture(tmp_path / "a.tiff")
    (tmp_path / "a.heic").write_bytes(b"\0\0\0\x18ftypheic" + bytes(100))
    with pytest.raises(CaptureError, match="pillow-heif|cannot be decoded"):
        read_picture(tmp_path / "a.heic")


@pytest.mark.parametrize(
    "stem",
    [
        lambda camera, k: f"{k:0{4 + camera}d}",
        lambda camera, k: f"00_{camera:02d}_{k:08d}",
        lambda camera, k: f"c{camera}-{k}",
        lambda camera, k: f"{k:06d}_{camera}.left",
    ],
)
def test_numbers_are_instants_whatever_their_padding_and_prefix(stem: Callable[[int, int], str]) -> None:
    """The last camera begins one instant later."""
    pictures = {
        f"00_{camera:02d}": [Path(f"{stem(camera, k + (camera == 2))}.png") for k in range(8, 12)]
        for camera in range(3)
    }
    slots = picture_slots(pictures)
    assert slots["00_00"].tolist() == [0, 1, 2, 3]
    assert slots["00_02"].tolist() == [1, 2, 3, 4]
    common, _ = common_pictures(
        {name: {file.stem: file for file in files} for name, files in pictures.items()},
        where=Path("take"),
        training=pictures,
    )
    assert common["00_00"][0] == pictures["00_00"][1]


def test_numbers_of_other_names_are_reported_and_names_that_share_nothing_refused(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    def common(**stems: str) -> None:
        common_pictures(
            {name: {stem: Path(stem) for stem in own.split()} for name, own in stems.items()},
            where=tmp_path,
            training=stems,
        )

    common(a="a_1 a_2", b="b_1 b_2")  # each has its camera's name
    assert not caplog.records
    common(a="DSC_3 DSC_4", b="IMG_3 IMG_4")
    assert "'a' (DSC_3) and 'b' (IMG_3) have other names, and are matched by their numbers alone" in caplog.text
    with pytest.raises(CaptureError, match=r"'a' \(GOPR10, ...\) and 'b' .*no names and no numbers in common"):
        common(a="GOPR10 GOPR11", b="GOPR20 GOPR21")


def test_a_link_that_leads_nowhere_is_named(tmp_path: Path) -> None:
    (tmp_path / "cam00.mp4").symlink_to(tmp_path / "gone.mp4")
    with pytest.raises(CaptureError, match="is a link to .*gone.mp4, which does not exist"):
        files_of(tmp_path, (".mp4",))
    with pytest.raises(CaptureError, match="is a link to"):
        find_footage(tmp_path)


def test_a_picture_beside_the_folder_of_videos_is_no_camera(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / "videos").mkdir()
    videos(tmp_path / "videos", ".mp4")
    cv2.imwrite(str(tmp_path / "plan.jpg"), np.zeros((48, 64, 3), np.uint8))
    with caplog.at_level(logging.WARNING):
        assert find_footage(tmp_path).cameras == tuple(RIG)
    assert "left out" in caplog.text
