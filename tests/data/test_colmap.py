# SPDX-License-Identifier: Apache-2.0
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from structgstream.data.colmap import find_model, read_model
from structgstream.data.lenses import Fisheye, Lens, Pinhole, RadialTangential
from structgstream.errors import CalibrationError
from tests.support.captures import quaternion, small_rig, write_binary_model, write_text_model

POINTS = np.array([[1.0, 2.0, 3.0], [-0.5, 0.25, 7.0]])
RIG = small_rig(3)
IMAGES = [(f"{name} left/000000.png", name) for name in reversed(list(RIG))]  # a space in every name


@pytest.fixture(params=["text", "binary"])
def folder(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    if request.param == "text":
        write_text_model(tmp_path / "sparse", RIG, IMAGES, points=POINTS)
    else:
        write_binary_model(tmp_path / "sparse", RIG, IMAGES, points=POINTS)
    return tmp_path / "sparse"


def test_both_formats_give_the_cameras_and_the_points(folder: Path) -> None:
    model = read_model(folder)
    assert [image.name for image in model.cameras] == [f"{name} left/000000.png" for name in RIG]
    for image, camera in zip(model.cameras, RIG.cameras.values(), strict=True):
        np.testing.assert_allclose(image.viewmat, camera.viewmat.numpy(), atol=1e-9)
        np.testing.assert_allclose(image.K, camera.K.numpy())
        assert image.size == (camera.width, camera.height)
        assert image.lens == Pinhole()
    assert model.points is not None
    np.testing.assert_array_equal(model.points, POINTS)


def test_points_are_optional(folder: Path) -> None:
    for file in folder.glob("points3D.*"):
        file.unlink()
    assert read_model(folder).points is None


@pytest.mark.parametrize("stem", ["cameras", "images", "points3D"])
def test_a_cut_file_is_named_by_its_folder(tmp_path: Path, stem: str) -> None:
    write_binary_model(tmp_path / "sparse", RIG, IMAGES, points=POINTS)
    file = tmp_path / "sparse" / f"{stem}.bin"
    file.write_bytes(file.read_bytes()[:-9])
    with pytest.raises(CalibrationError, match=f"COLMAP model in {tmp_path / 'sparse'} cannot be read"):
        read_model(tmp_path / "sparse")


@pytest.mark.parametrize("line", ["1 PINHOLE 64", "x y z w 1 2 3 4", "1 PINHOLE 64 48 40 40 32"])
def test_broken_text_is_named_by_its_folder(tmp_path: Path, line: str) -> None:
    write_text_model(tmp_path, RIG, IMAGES)
    (tmp_path / "cameras.txt").write_text(line)
    with pytest.raises(CalibrationError, match="cannot be read"):
        read_model(tmp_path)


@pytest.mark.parametrize(
    ("number", "model", "params", "fy", "lens"),
    [
        (2, "SIMPLE_RADIAL", [40, 32, 24, 0.1], 40, RadialTangential(k1=0.1)),
        (3, "RADIAL", [40, 32, 24, 0.1, 0.2], 40, RadialTangential(k1=0.1, k2=0.2)),
        (4, "OPENCV", [40, 41, 32, 24, 1, 2, 3, 4], 41, RadialTangential(k1=1, k2=2, p1=3, p2=4)),
        (5, "OPENCV_FISHEYE", [40, 41, 32, 24, 1, 2, 3, 4], 41, Fisheye(1, 2, 3, 4)),
        (
            6,
            "FULL_OPENCV",
            [40, 41, 32, 24, 1, 2, 3, 4, 5, 6, 7, 8],
            41,
            RadialTangential(k1=1, k2=2, p1=3, p2=4, k3=5, k4=6, k5=7, k6=8),
        ),
        (8, "SIMPLE_RADIAL_FISHEYE", [40, 32, 24, 0.1], 40, Fisheye(0.1)),
        (9, "RADIAL_FISHEYE", [40, 32, 24, 0.1, 0.2], 40, Fisheye(0.1, 0.2)),
    ],
)
def test_lens_models(tmp_path: Path, number: int, model: str, params: list[float], fy: float, lens: Lens) -> None:
    """The order of parameters is that of COLMAP's documentation, "Camera Models"."""
    write_text_model(tmp_path, RIG.with_held_out(frozenset()), [("a.png", "cam00")])
    (tmp_path / "cameras.txt").write_text(f"1 {model} 64 48 {' '.join(map(str, params))}\n")
    (text,) = read_model(tmp_path).cameras
    (tmp_path / "cameras.bin").write_bytes(struct.pack(f"<QiiQQ{len(params)}d", 1, 1, number, 64, 48, *params))
    pose = (*quaternion(RIG["cam00"]), 0, 0, 0)
    image = struct.pack("<Qi7di", 1, 1, *pose, 1) + b"a.png\0" + struct.pack("<Q", 0)
    (tmp_path / "images.bin").write_bytes(image)
    (binary,) = read_model(tmp_path).cameras
    for camera in (text, binary):
        assert camera.lens == lens
        assert camera.K.tolist() == [[40, 0, 32], [0, fy, 24], [0, 0, 1]]
        assert camera.size == (64, 48)


def test_other_lens_models_are_refused_by_name(tmp_path: Path) -> None:
    write_text_model(tmp_path, RIG, IMAGES)
    (tmp_path / "cameras.txt").write_text("1 FOV 64 48 40 40 32 24 0.1\n")
    with pytest.raises(CalibrationError, match=r"cameras\.txt has a camera of model FOV.*OPENCV_FISHEYE.*undistort"):
        read_model(tmp_path)
    (tmp_path / "cameras.bin").write_bytes(struct.pack("<QiiQQ4d", 1, 1, 10, 64, 48, 40, 32, 24, 0.1))
    (tmp_path / "images.bin").write_bytes(struct.pack("<Q", 0))
    with pytest.raises(CalibrationError, match=r"cameras\.bin has a camera of model THIN_PRISM_FISHEYE"):
        read_model(tmp_path)
    (tmp_path / "cameras.bin").write_bytes(struct.pack("<QiiQQ4d", 1, 1, 77, 64, 48, 40, 32, 24, 0.1))
    with pytest.raises(CalibrationError, match="model number 77"):
        read_model(tmp_path)


def test_where_a_model_is_looked_for(tmp_path: Path) -> None:
    assert find_model(tmp_path) is None
    for folder in (tmp_path, tmp_path / "sparse", tmp_path / "sparse" / "0"):
        write_text_model(folder, RIG, IMAGES)
        assert find_model(tmp_path) == folder


@pytest.mark.parametrize(
    "change",
    [
        pytest.param(lambda text: "\ufeff" + text.replace("\n", "\r\n"), id="windows"),
        pytest.param(lambda text: text.replace(".0", ",0").replace(".5", ",5"), id="decimal-commas"),
        pytest.param(
            lambda text: "\n".join(row for row in text.split("\n") if row not in ("", "1.5 2.5 -1")), id="short"
        ),
    ],
)
def test_text_as_people_have_it(tmp_path: Path, change: Callable[[str], str]) -> None:
    """Also a list of pictures without lines of 2D points; one whose name ends with numbers is a picture."""
    images = [*IMAGES, ("take 1 0001", "cam00")]
    write_text_model(tmp_path, RIG, images)
    plain = read_model(tmp_path)
    for file in tmp_path.iterdir():
        head, body = file.read_text().split("\n", 1)
        file.write_text(head + "\n" + change(body) if "\ufeff" not in change("") else change(head + "\n" + body))
    found = read_model(tmp_path)
    assert [image.name for image in found.cameras] == [image.name for image in plain.cameras]
    for image, other in zip(found.cameras, plain.cameras, strict=True):
        np.testing.assert_array_equal(image.viewmat, other.viewmat)
