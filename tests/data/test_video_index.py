# SPDX-License-Identifier: Apache-2.0
"""What phones and camcorders write: turned, mirrored, 10 bit, interlaced, and coded in unknown ways."""

import re
from collections.abc import Mapping, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from av.codec.context import Flags

from structgstream.cameras import CameraRig
from structgstream.data.video import VideoSource, synchronised
from structgstream.data.video_index import scan_videos
from structgstream.errors import CaptureError
from tests.support.captures import Picture, picture, small_rig, write_videos

RIG = small_rig(3)


def corners(width: int = 64, height: int = 48) -> Picture:
    """A red, a green, a blue and a white corner, from the top left clockwise."""
    image = np.zeros((height, width, 3), np.uint8)
    down, across = height // 2, width // 2
    image[:down, :across, 0] = image[:down, across:, 1] = image[down:, across:, 2] = 220
    image[down:, :across] = 220
    return image


def write(
    path: Path,
    pictures: Sequence[Picture],
    *,
    codec: str = "libx264",
    pixels: str = "yuv444p",
    turn: int | None = None,
    mirrored: bool = False,
    options: Mapping[str, str] | None = None,
    interlaced: bool = False,
    aspect: Fraction | None = None,
) -> None:
    with av.open(str(path), "w") as container:
        stream: Any = container.add_stream(codec, rate=30, options=dict(options or {}))
        stream.height, stream.width = pictures[0].shape[:2]
        stream.pix_fmt = pixels
        if interlaced:
            stream.codec_context.flags |= Flags.interlaced_dct | Flags.interlaced_me
        if aspect is not None:
            stream.codec_context.sample_aspect_ratio = aspect
        if turn is not None:
            stream.set_display_rotation(turn, hflip=mirrored)
        for number, image in enumerate(pictures):
            frame = av.VideoFrame.from_ndarray(image, format="rgb24").reformat(format=pixels)
            frame.pts, frame.time_base = number, Fraction(1, 30)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def read(folder: Path, rig: CameraRig = RIG) -> VideoSource:
    return synchronised(scan_videos({name: folder / f"{name}.mp4" for name in rig}), rig, where=folder)


@pytest.mark.parametrize(("turn", "quarters"), [(0, 0), (90, 1), (180, 2), (-90, 3)])
def test_turned_videos_are_read_as_they_are_shown(tmp_path: Path, turn: int, quarters: int) -> None:
    for name in RIG:
        write(tmp_path / f"{name}.mp4", [corners()] * 5, turn=turn, options={"qp": "0"})
    expected = np.rot90(corners(), quarters)  # counterclockwise
    size = expected.shape[1::-1]
    rig = RIG.mapped({name: RIG[name].resized(*size) for name in RIG})
    source = read(tmp_path, rig)
    track = source.tracks["cam00"]
    assert (track.width, track.height, track.quarter_turns) == (*size, quarters)
    for frame in source.frames(2):
        np.testing.assert_allclose(frame.images["cam01"], expected, atol=4)
    half = rig.mapped({name: rig[name].resized(size[0] // 2, size[1] // 2) for name in rig})
    smaller = next(source.resized(half).frames()).images["cam01"]
    np.testing.assert_allclose(smaller, expected[::2, ::2], atol=4)


@pytest.mark.parametrize(
    ("said", "written"),
    [
        ("say that it is turned by an angle that is not a quarter turn; convert it", {"turn": 30}),
        ("say that it is mirrored", {"turn": 0, "mirrored": True}),
        (
            "is interlaced: its lines are of two instants; set the camera to a progressive",
            {"pixels": "yuv420p", "interlaced": True, "options": {"x264-params": "tff=1"}},
        ),
        (  # Screen recorders write it; read as BT.709 it is green and violet.
            "states a colour matrix (YCgCo) that is not read; expected RGB, BT.601",
            {"options": {"x264-params": "colormatrix=YCgCo"}},
        ),
        *(  # Log videos state no transfer function; others would be shown pale.
            (
                "has the primaries of BT.2020 and does not state HLG or PQ",
                {"options": {"x264-params": f"colorprim=bt2020:transfer={transfer}:colormatrix=bt2020nc"}},
            )
            for transfer in ("undef", "bt2020-10")
        ),
        ("has the primaries of DCI-P3", {"options": {"x264-params": "colorprim=smpte431"}}),
    ],
)
def test_what_is_refused(tmp_path: Path, said: str, written: dict[str, Any]) -> None:
    write(tmp_path / "a.mp4", [corners()] * 5, **written)
    with pytest.raises(CaptureError, match=re.escape(f"a.mp4 {said}")):
        scan_videos({"a": tmp_path / "a.mp4"})


def test_display_p3_is_converted_to_srgb(tmp_path: Path) -> None:
    """The red, green and blue of sRGB have these values in Display P3; grey has the same in both."""
    coded = [(234, 51, 35), (117, 251, 76), (0, 0, 245), (128, 128, 128)]
    expected = [(255, 0, 0), (0, 255, 0), (0, 0, 255), (128, 128, 128)]
    shown = np.repeat(np.repeat(np.array([coded], np.uint8), 48, axis=0), 16, axis=1)
    for name in RIG:
        write(tmp_path / f"{name}.mp4", [shown] * 2, options={"qp": "0", "x264-params": "colorprim=smpte432"})
    source = read(tmp_path)
    shown = next(source.frames()).images["cam00"][24, 8::16]
    np.testing.assert_allclose(shown, expected, atol=16)  # Near 0 a step of the file is up to 13 steps of sRGB.
    np.testing.assert_allclose(shown[3], 128, atol=2)


def test_the_shape_of_pixels_is_read(tmp_path: Path) -> None:
    for name, aspect in (("a", Fraction(4, 3)), ("b", None)):
        write(tmp_path / f"{name}.mp4", [corners()] * 2, aspect=aspect)
        expected = pytest.approx(float(aspect or 1))
        assert scan_videos({"a": tmp_path / f"{name}.mp4"})["a"].pixel_aspect == expected


def test_ten_bit_hevc_is_read(tmp_path: Path) -> None:
    for name in RIG:
        quiet = {"x265-params": "log-level=none:lossless=1"}
        write(tmp_path / f"{name}.mp4", [corners()] * 5, codec="libx265", pixels="yuv444p10le", options=quiet)
    source = read(tmp_path)
    for start in (0, 3):
        np.testing.assert_allclose(next(source.frames(start)).images["cam00"], corners(), atol=4)


def test_open_groups_of_hevc_are_sought_exactly(tmp_path: Path) -> None:
    """Frames before a key frame in time may come after it in the file, and need the group before."""
    params = "log-level=none:lossless=1:keyint=6:min-keyint=6:open-gop=1:bframes=3:scenecut=0"
    for number, name in enumerate(RIG):
        pictures = [picture(number, index) for index in range(20)]
        write(tmp_path / f"{name}.mp4", pictures, codec="libx265", options={"x265-params": params})
    source = read(tmp_path)
    assert len(source.tracks["cam00"].keyframes) > 2
    whole = [frame.images["cam01"] for frame in source.frames()]
    assert len(whole) == 20
    for start in range(20):
        np.testing.assert_array_equal(next(source.frames(start)).images["cam01"], whole[start])


def test_an_unknown_codec_is_named_in_one_sentence(tmp_path: Path) -> None:
    write_videos(tmp_path, ["a"], frames=3)
    data = (tmp_path / "a.mp4").read_bytes()
    (tmp_path / "a.mp4").write_bytes(data.replace(b"avc1", b"zzzz"))
    with pytest.raises(CaptureError, match=r"a\.mp4 is coded in a way that the installed PyAV cannot decode"):
        scan_videos({"a": tmp_path / "a.mp4"})
