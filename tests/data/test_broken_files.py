# SPDX-License-Identifier: Apache-2.0
"""Cut and changed calibration files give cameras or one sentence of the package's own: nothing else, in no reader."""

import re
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest

from structgstream.data.colmap import read_model
from structgstream.data.images import picture_size, read_exif, read_picture
from structgstream.data.lenses import Fisheye, LensCamera, Pinhole, RadialTangential
from structgstream.data.open import open_capture, read_calibration
from structgstream.data.posed_capture import filmed_by
from structgstream.data.prepared import PreparedCamera, PreparedCapture, write_prepared
from structgstream.data.timeline import Clock
from structgstream.data.undistortion import rectilinear
from structgstream.data.video import pictures_at
from structgstream.data.video_index import scan_videos
from structgstream.errors import StructGStreamError
from tests.support.calibrations import OF_PINHOLES, WRITERS, truths
from tests.support.captures import (
    HEIGHT,
    WIDTH,
    picture,
    small_rig,
    write_binary_model,
    write_clip,
    write_immersive,
    write_n3dv,
    write_panoptic,
    write_picture,
    write_shared_intrinsics,
    write_text_model,
    write_video,
)
from tests.support.properties import THOROUGH

PYTHONS_WORDS = re.compile(
    r"\b\w+Error\b|\b(NoneType|int|float|str|dict|tuple|object|dtype|literal|codec|subscript\w*|unpack|argument|"
    r"keyword|iterable|hashable|inhomogeneous|broadcast|buffer|BadZipFile|pickle data|opcode)\b"
)
TOKENS = (b"null", b"-1", b"1e400", b"nan", b"{}", b"[]", b'"x"', b"true", b"\xff\xfe", b"\0", b"[[", b"0", b"\n", b",")


def mutated(data: bytes, seed: int) -> bytes:
    """Cut, with a piece removed or doubled, with other bytes, or with a number replaced by what is none."""
    rng = np.random.default_rng(seed)
    at, other = sorted(int(place) for place in rng.integers(0, len(data), 2))
    token = TOKENS[int(rng.integers(len(TOKENS)))]
    match seed % 6:
        case 0:
            return data[:at]
        case 1:
            return data[:at] + data[min(other, at + 40) :]
        case 2:
            changed = bytearray(data)
            for place in rng.integers(0, len(data), 3):
                changed[place] = int(rng.integers(256))
            return bytes(changed)
        case 3:
            return data[:at] + token + data[at:]
        case 4:
            return data[:other] + data[at:]
    numbers = list(re.finditer(rb"-?\d+(\.\d+)?(e-?\d+)?|\"\w+\"", data)) or [re.match(b"", data)]
    found = numbers[int(rng.integers(len(numbers)))]
    assert found is not None
    return data[: found.start()] + token + data[found.end() :]


def check_mutants(
    folder: Path, files: Sequence[Path], read: Callable[[], object], *, count: int, noticed: bool = True
) -> None:
    whole = {file: file.read_bytes() for file in files}
    refused = 0
    for seed in range(count):
        file = files[seed % len(files)]
        file.write_bytes(mutated(whole[file], seed))
        try:
            read()
        except StructGStreamError as error:
            refused += 1
            reported = str(error).replace(str(folder), "FOLDER").replace(str(folder.parent), "FOLDER")
            assert not PYTHONS_WORDS.search(reported), f"mutant {seed} of {file.name}: {reported}"
        except BaseException as error:
            raise AssertionError(f"mutant {seed} of {file.name}") from error
        finally:
            file.write_bytes(whole[file])
    assert refused > count // 10 or not noticed  # what is cut is noticed


@pytest.mark.parametrize("tool", WRITERS | OF_PINHOLES)
def test_files_of_tools(tool: str, tmp_path: Path) -> None:
    (WRITERS | OF_PINHOLES)[tool](tmp_path, truths())
    names = {"kalibr": ("cam0", "cam1", "cam2"), "cmu_panoptic": ("00_00", "00_01", "00_02")}
    sizes = dict.fromkeys(names.get(tool, ("cam00", "cam01", "cam02")), (WIDTH, HEIGHT))

    def read() -> None:
        if (calibration := read_calibration(tmp_path)) is not None:
            filmed_by(calibration, sizes, root=tmp_path)

    check_mutants(tmp_path, sorted(tmp_path.glob("*.*")), read, count=1000 if THOROUGH else 36)


@pytest.mark.parametrize("binary", [False, True])
def test_models_of_colmap(binary: bool, tmp_path: Path) -> None:
    rig = small_rig(3)
    pictures = [(f"{name}.png", name) for name in rig]
    (write_binary_model if binary else write_text_model)(tmp_path, rig, pictures, points=np.eye(3))
    sizes = dict.fromkeys(rig, (WIDTH, HEIGHT))
    files = sorted(tmp_path.glob("*.bin" if binary else "*.txt"))
    read = lambda: filmed_by(read_model(tmp_path), sizes, root=tmp_path)  # noqa: E731
    check_mutants(tmp_path, files, read, count=1000 if THOROUGH else 60)


def write_prepared_folders(path: Path) -> None:
    """A prepared capture of pictures with every kind of value, and masks."""
    rig, cameras = small_rig(3), {}
    lenses = (Pinhole(), RadialTangential(k1=-0.1, p1=0.001), Fisheye(k1=0.02))
    for number, (name, lens) in enumerate(zip(rig, lenses, strict=True)):
        filmed = LensCamera(rig[name], lens)
        cameras[name] = PreparedCamera(f"images/{name}", filmed, rectilinear(filmed), Clock(0.01, 1.0))
        for frame in range(2):
            write_picture(path / f"images/{name}/{frame}.png", picture(number, frame))
    write_picture(path / "masks/cam00.png", np.full((HEIGHT, WIDTH, 3), 255, np.uint8))
    np.save(path / "points.npy", np.eye(3))
    write_prepared(path, PreparedCapture(cameras, 30.0, 0.25, "metres", frozenset({"cam01"}), "points.npy"))


CAPTURES: dict[str, tuple[Callable[..., object], Sequence[str]]] = {
    "panoptic": (write_panoptic, ("train_meta.json", "test_meta.json")),
    "clip": (write_clip, ("cameras.json",)),
    "shared": (write_shared_intrinsics, ("cameras.json",)),
    "n3dv": (write_n3dv, ("poses_bounds.npy",)),
    "immersive": (write_immersive, ("models.json",)),
    "prepared": (write_prepared_folders, ("capture.json",)),
    "prepared-points": (write_prepared_folders, ("points.npy", "masks/cam00.png")),
}


@pytest.mark.parametrize("layout", CAPTURES)
def test_captures(layout: str, tmp_path: Path) -> None:
    write, names = CAPTURES[layout]
    write(tmp_path)
    files = [tmp_path / name for name in names]
    check_mutants(tmp_path, files, lambda: open_capture(tmp_path), count=1000 if THOROUGH else 24)
    shutil.rmtree(tmp_path)


@pytest.mark.parametrize("ending", [".jpg", ".png", ".tiff", ".webp", ".bmp", ".ppm"])
def test_pictures(tmp_path: Path, ending: str) -> None:
    file = tmp_path / f"a{ending}"
    cv2.imwrite(str(file), np.random.default_rng(1).integers(0, 255, (24, 32, 3), np.uint8))
    read = lambda: (picture_size(file), read_exif(file), read_picture(file))  # noqa: E731
    check_mutants(tmp_path, [file], read, count=1000 if THOROUGH else 24, noticed=False)


@pytest.mark.parametrize("ending", [".mp4", ".mkv", ".ts", ".avi", ".webm"])
def test_videos(tmp_path: Path, ending: str) -> None:
    write_video(tmp_path / "whole.mp4", [picture(0, frame) for frame in range(6)])
    file = tmp_path / f"cam00{ending}"
    with av.open(str(tmp_path / "whole.mp4")) as whole, av.open(str(file), "w") as container:
        codec = {".webm": "libvpx-vp9", ".avi": "mpeg4"}.get(ending, "libx264")
        stream: Any = container.add_stream(codec, rate=30, options={"g": "3"})
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        for frame in whole.decode(video=0):
            container.mux(stream.encode(frame.reformat(format="yuv420p")))
        container.mux(stream.encode())

    def read() -> None:
        track = scan_videos({"cam00": file})["cam00"]
        list(pictures_at(track, track.stamps, size=(WIDTH, HEIGHT), on_damage=lambda *_: None))

    check_mutants(tmp_path, [file], read, count=1000 if THOROUGH else 12, noticed=False)
