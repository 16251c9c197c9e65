# SPDX-License-Identifier: Apache-2.0
"""Calibrations and frames where tools leave them: which are found, together, and with which cameras."""

import json
import logging
import re
import shutil
import unicodedata
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from structgstream.data.calibration import Calibration, rotation_matrix
from structgstream.data.lenses import Fisheye, RadialTangential, from_integer_centers
from structgstream.data.open import open_capture, read_calibration
from structgstream.errors import CalibrationError, CaptureError
from tests.support.calibrations import (
    NAMES,
    WRITERS,
    Truth,
    opencv_matrix,
    truths,
    write_anipose,
    write_easymocap,
    write_kalibr,
    write_opencv,
    write_projections,
)
from tests.support.captures import (
    HEIGHT,
    WIDTH,
    numbers,
    picture,
    small_rig,
    write_picture,
    write_pictures,
    write_text_model,
    write_videos,
)

RIG = small_rig(3)


def check_opens(folder: Path, *, frames: int = 2, names: tuple[str, ...] = NAMES) -> None:
    source = open_capture(folder)
    assert list(source.rig) == list(names)
    assert len(source) == frames
    shown = next(iter(source.frames())).images
    assert [numbers(shown[name])[0] for name in names] == list(range(len(names)))


def read(folder: Path) -> Calibration:
    found = read_calibration(folder)
    assert found is not None
    return found


pictures = partial(write_pictures, names=NAMES, frames=2)


def model(folder: Path) -> None:
    write_text_model(folder, RIG, [(f"{name}.png", name) for name in RIG])


@pytest.mark.parametrize(
    ("pattern", "calibrate"),
    [
        pytest.param("CAM/frame_FRAME.png", lambda path: model(path / "sparse_"), id="4dgaussians"),
        pytest.param("frameFRAME/images/CAM.png", lambda path: model(path / "frame000000/sparse/0"), id="3dgstream"),
        pytest.param("frames/frameFRAME/images/CAM.png", lambda path: model(path / "sparse/0"), id="3dgstream-model"),
        pytest.param("CAM/data/FRAME.png", lambda path: model(path / "sparse/1"), id="euroc"),
        pytest.param("dense/images/CAM/FRAME.png", lambda path: model(path / "dense/sparse"), id="dense"),
        pytest.param("dense/0/images/CAM/FRAME.png", lambda path: model(path / "dense/0/sparse"), id="dense-0"),
        pytest.param("images/CAM/FRAME.png", lambda path: calibrated(path / "calibration"), id="one-folder-apart"),
        pytest.param("Images/CAM/FRAME.ppm", lambda path: model(path / "sparse/0"), id="capitals"),
        pytest.param("input/CAM/FRAME.png", lambda path: model(path / "sparse/0"), id="another-name"),
        pytest.param("data/images/CAM/FRAME.png", lambda path: model(path / "sparse/0"), id="two-below"),
        pytest.param("a/b/images/CAM/FRAME.png", lambda path: model(path / "a/b/sparse/0"), id="two-too-high"),
    ],
)
def test_folders_of_pictures(tmp_path: Path, pattern: str, calibrate: Callable[[Path], None]) -> None:
    pictures(tmp_path, pattern)
    calibrate(tmp_path)
    check_opens(tmp_path)


def calibrated(folder: Path, cameras: list[Truth] | None = None) -> None:
    folder.mkdir(exist_ok=True)
    write_anipose(folder, cameras or truths(dist=(0, 0, 0, 0)))


@pytest.mark.parametrize(
    ("videos", "calibration"),
    [
        pytest.param("synchronized_videos", "", id="freemocap"),
        pytest.param("videos", "calibration", id="pose2sim"),
        pytest.param("recordings/walk", "", id="caliscope"),
        pytest.param("take1", "calib_2026", id="a-take"),
    ],
)
def test_projects_given_whole(tmp_path: Path, videos: str, calibration: str) -> None:
    write_videos(tmp_path / videos, NAMES, frames=2)
    calibrated(tmp_path / calibration)
    if calibration == "calibration":  # Pose2Sim calibrates from pictures that are no capture
        for camera, name in enumerate(NAMES):
            write_picture(tmp_path / f"calibration/extrinsics/ext_{name}_img/{name}.png", picture(camera + 4, 7))
    check_opens(tmp_path)
    shutil.copytree(tmp_path / videos, (tmp_path / videos).with_name("another"))
    if videos not in ("videos", "synchronized_videos"):
        with pytest.raises(CaptureError, match=r"videos in several folders .*Give the folder of one take"):
            open_capture(tmp_path)


def projection(camera: Truth) -> np.ndarray:
    return 2.5 * camera.K @ camera.viewmat[:3]


def write_idr(folder: Path) -> None:
    matrices = (np.vstack([projection(camera), [0, 0, 0, 1]]) for camera in PINHOLES)
    worlds = {f"world_mat_{number}": matrix for number, matrix in enumerate(matrices)}
    np.savez(folder / "cameras_sphere.npz", allow_pickle=False, scale_mat_0=np.eye(4), **worlds)


def write_storage(folder: Path) -> None:
    for camera in PINHOLES:
        matrix = opencv_matrix("proj_matrix", projection(camera))
        (folder / f"{camera.name}.yml").write_text(f"%YAML:1.0\n---\n{matrix}")


PINHOLES = truths(dist=(0, 0, 0, 0, 0))


@pytest.mark.parametrize("write", [lambda folder: write_projections(folder, PINHOLES), write_idr, write_storage])
def test_projection_matrices_alone(tmp_path: Path, write: Callable[[Path], None]) -> None:
    """Of any scale, also negative: they are K [R | t]."""
    write(tmp_path)
    write_videos(tmp_path, NAMES, frames=2)
    check_opens(tmp_path)
    for truth, camera in zip(PINHOLES, open_capture(tmp_path).rig.cameras.values(), strict=True):
        np.testing.assert_allclose(camera.viewmat, truth.viewmat, atol=1e-9)
        np.testing.assert_allclose(camera.K, from_integer_centers(truth.K), atol=1e-9)


def test_matrices_of_opencv_as_lists_in_json(tmp_path: Path) -> None:
    write_videos(tmp_path, NAMES, frames=2)
    content = {
        camera.name: {
            "cameraMatrix": camera.K.tolist(), "distCoeffs": [[0, 0, 0, 0, 0]], "imageSize": [WIDTH, HEIGHT],
            "rvec": camera.rvec.tolist(), "tvec": [[number] for number in camera.T.tolist()],
        }
        for camera in PINHOLES
    }  # fmt: skip
    (tmp_path / "calibration.json").write_text(json.dumps(content))
    check_opens(tmp_path)
    (tmp_path / "calibration.json").write_text(json.dumps({"cameras": list(content.values())}))  # without names
    check_opens(tmp_path)


@pytest.mark.parametrize(
    ("key", "value", "lens"),
    [
        ("distortion_model", "equidistant", Fisheye),
        ("camera_model", "FISHEYE", Fisheye),
        ("is_fisheye", True, Fisheye),
        ("lens", "Kannala-Brandt", Fisheye),
        ("distortion_type", "1", Fisheye),
        ("fisheye", "False", RadialTangential),
        ("distortion_type", "radtan", RadialTangential),
        ("distortion_model", "plumb_bob", RadialTangential),
        ("model", "ZCAM E2", RadialTangential),
        ("model", "omnidirectional", None),
    ],
)
def test_the_lens_model_is_what_a_file_calls_it(
    tmp_path: Path, key: str, value: object, lens: type[Fisheye] | type[RadialTangential] | None
) -> None:
    content = {
        camera.name: {"K": camera.K.tolist(), "D": [0.1, 0.02, 0.003, 0.001], "R": camera.R.tolist(), "T": [0, 0, 3]}
        for camera in PINHOLES
    }
    for entry in content.values():
        entry[key] = value
    (tmp_path / "calibration.json").write_text(json.dumps(content))
    if lens is None:
        words = r"'cam00' of .*\(the lens model omnidirectional, which is not known"
        with pytest.raises(CalibrationError, match=words):
            read_calibration(tmp_path)
        return
    found = read(tmp_path)
    assert {camera.lens for camera in found.cameras} == {lens(0.1, 0.02, 0.003, 0.001)}


@pytest.mark.parametrize("content", ["cameras: [a, b, c, d, e, f, g, h, i]", "matrix: [a, b, {c: d}, [e]]"])
def test_lists_of_words_are_no_matrices(tmp_path: Path, content: str) -> None:
    """Nine names look like a matrix of nine numbers."""
    (tmp_path / "take.yaml").write_text(content)
    calibrated(tmp_path)
    assert read_calibration(tmp_path) is not None


@pytest.mark.parametrize(
    ("stem", "step", "words"),
    [
        ("thumb", 2, "several sizes, frame_000000.png of .* and thumb.png of"),
        ("thumb_000000", 2, "several series: frame_000000.png and thumb_000000.png have the same number"),
        ("depth_000000", 1, "several series: depth_000000.png and frame_000000.png have the same number"),
        ("frame_000000_mask", 1, "several series: frame_000000.png and frame_000000_mask.png have the same number"),
    ],
)
def test_a_second_series_among_the_pictures_is_refused(tmp_path: Path, stem: str, step: int, words: str) -> None:
    """Depth maps and masks were read as frames."""
    pictures(tmp_path, "images/CAM/frame_FRAME.png")
    model(tmp_path / "sparse/0")
    write_picture(tmp_path / f"images/cam01/{stem}.png", picture(1, 0)[::step, ::step])
    with pytest.raises(CaptureError, match=f"camera 'cam01' in .* are of {words}"):
        open_capture(tmp_path)


@pytest.mark.parametrize("beside", ["depth", "mask"])
def test_one_picture_a_camera_beside_maps_of_the_same_names(tmp_path: Path, beside: str) -> None:
    for camera, name in enumerate(NAMES):
        write_picture(tmp_path / "image" / f"{name}.png", picture(camera, 0))
        write_picture(tmp_path / beside / f"{name}.png", picture(7, 7))
    model(tmp_path / "sparse/0")
    check_opens(tmp_path, frames=1)


def test_poses_without_intrinsics_are_no_projection_matrices(tmp_path: Path) -> None:
    for camera in PINHOLES:
        np.savetxt(tmp_path / f"{camera.name}.txt", camera.viewmat[:3])
    words = r"Camera 'cam00' .*\(a pose without intrinsics, in place of a projection"
    with pytest.raises(CalibrationError, match=words):
        read_calibration(tmp_path)


@pytest.mark.parametrize("place", ["optimized/cameras", "meta/calib"])
def test_a_calibration_two_folders_below(tmp_path: Path, place: str) -> None:
    """As EasyVolcap has it."""
    write_videos(tmp_path / "videos", NAMES, frames=2)
    (tmp_path / place).mkdir(parents=True)
    write_easymocap(tmp_path / place, PINHOLES)
    check_opens(tmp_path)


def test_pieces_of_videos(tmp_path: Path) -> None:
    calibrated(tmp_path)
    for name in NAMES:
        (tmp_path / name).mkdir()
        (tmp_path / name / "chunk-stream0-00001.m4s").write_bytes(b"styp")
    words = r"cam00.chunk-stream0-00001.m4s is a piece of a video: join the pieces of each"
    with pytest.raises(CaptureError, match=words):
        open_capture(tmp_path)


def test_a_folder_per_camera_with_its_own_file(tmp_path: Path) -> None:
    write_videos(tmp_path, NAMES, frames=2)
    write_opencv(tmp_path, truths(dist=(0, 0, 0, 0)))
    for name in NAMES:
        (tmp_path / name / "DCIM/100GOPRO").mkdir(parents=True)
        (tmp_path / f"{name}.mp4").rename(tmp_path / name / "DCIM/100GOPRO/GX010001.MP4")
        (tmp_path / f"{name}.yml").rename(tmp_path / name / "config.yml")
    check_opens(tmp_path)


@pytest.mark.parametrize(
    "keys",
    [
        "cameraMatrix distCoeffs R T",
        "M D R T",
        "cam_K cam_dist cam_R cam_t",
        "K dist rot_mat tvecs",
        "CameraMatrix DistortionCoeffs Rotation Translation",
        "intrinsic_matrix dist_coeffs rvec tvec",
        "mtx dist rotation_vector translation_vector",
    ],
)
@pytest.mark.parametrize("form", ["yml", "plain.yaml", "json", "list.yaml"])
def test_spellings_of_opencv_files(tmp_path: Path, keys: str, form: str) -> None:
    """A file of settings beside them is none."""

    def matrix(value: Any) -> dict[str, Any]:
        rows = np.atleast_2d(value)
        own = {"rows": len(rows), "cols": rows.shape[1], "dt": "d", "data": rows.ravel().tolist()}
        return {"type_id": "opencv-matrix", **own}

    (tmp_path / "settings.yaml").write_text("%YAML:1.0\nCamera.fx: 500\n")
    entries = {}
    for truth in truths():
        turned = truth.rvec if "vec" in keys or "Rotation" in keys else truth.R
        values = dict(zip(keys.split(), (truth.K, truth.dist, turned, truth.T), strict=True))
        if form == "yml":
            text = f"%YAML:1.0\n---\nimage_Width: {WIDTH}\nImageHeight: {HEIGHT}\n"
            (tmp_path / f"{truth.name}.yml").write_text(text + "".join(opencv_matrix(*pair) for pair in values.items()))
        elif form == "json":
            size = {"image_size": {"width": WIDTH, "height": HEIGHT}}
            content = size | {key: matrix(own) for key, own in values.items()}
            (tmp_path / f"{truth.name}.json").write_text(json.dumps(content))
        else:
            own = {key: np.array(own).tolist() for key, own in values.items()}
            entries[truth.name] = {"size": [WIDTH, HEIGHT], **own}
            if form == "plain.yaml":
                (tmp_path / f"{truth.name}.yaml").write_text(json.dumps(entries[truth.name]))
    if form == "list.yaml":
        cameras = [{"name": name, **entry} for name, entry in entries.items()]
        (tmp_path / "rig.yaml").write_text(json.dumps({"cameras": cameras}))
    found = read(tmp_path)
    for truth, camera in zip(truths(), found.cameras, strict=True):
        assert (camera.name, camera.size) == (truth.name, (WIDTH, HEIGHT))
        np.testing.assert_allclose(camera.viewmat, truth.viewmat, atol=1e-9)


def test_what_file_servers_and_systems_leave_is_no_picture(tmp_path: Path) -> None:
    pictures(tmp_path, "images/CAM/FRAME.png")
    model(tmp_path / "sparse/0")
    stray_files = "@eaDir/thumb.jpg cam00/@eaDir/000000.png/SYNOPHOTO.jpg cam00/000003.png/a.png __MACOSX/a.png"
    for stray in stray_files.split():
        write_picture(tmp_path / "images" / stray, picture(7, 7))
    check_opens(tmp_path)


def test_names_may_have_their_letters_taken_apart(tmp_path: Path) -> None:
    names = tuple(f"Kämera {number}" for number in range(3))
    write_videos(tmp_path, [unicodedata.normalize("NFD", name) for name in names], frames=2)
    write_text_model(tmp_path, RIG, [(f"{name}.png", camera) for name, camera in zip(names, RIG, strict=True)])
    check_opens(tmp_path, names=names)


def test_calibrated_cameras_without_pictures_are_reported(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    pictures(tmp_path, "images/CAM/FRAME.png")
    write_text_model(tmp_path / "sparse/0", RIG, [(f"{name}/{frame}.png", name) for name in RIG for frame in range(2)])
    shutil.rmtree(tmp_path / "images/cam02")
    check_opens(tmp_path, names=NAMES[:2])
    assert "has no pictures of camera 'cam02/0.png'" in caplog.text


def test_calibrations_that_differ_are_refused(tmp_path: Path) -> None:
    cameras = truths()
    write_anipose(tmp_path, cameras).rename(tmp_path / "monday.toml")
    turn = rotation_matrix(np.array([0.4, -1.2, 2.0]))
    elsewhere = [replace(own, R=own.R @ turn.T, T=2.5 * own.T - own.R @ turn.T @ [3.0, -1.0, 0.5]) for own in cameras]
    write_anipose(tmp_path, elsewhere).rename(tmp_path / "copy.toml")  # in another world and unit
    found = read(tmp_path)
    assert found.where.name == "copy.toml"
    moved = [*cameras[:2], Truth("cam02", cameras[2].K, cameras[2].dist, cameras[2].R, cameras[2].T + 0.5)]
    write_anipose(tmp_path, moved).rename(tmp_path / "tuesday.toml")
    with pytest.raises(CalibrationError, match=r"several calibrations that differ, copy\.toml and tuesday\.toml"):
        read_calibration(tmp_path)
    assert read_calibration(tmp_path, tmp_path / "tuesday.toml") is not None


def test_the_largest_model_is_taken(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    pictures(tmp_path, "images/CAM/FRAME.png")
    model(tmp_path / "sparse/1")
    write_text_model(tmp_path / "sparse/0", RIG, [("cam00.png", "cam00"), ("cam01.png", "cam01")])
    check_opens(tmp_path)
    assert "several models: number 1 of 3 pictures is taken, number 0 of 2 left out" in caplog.text


@pytest.mark.parametrize("tool", ["anipose", "easymocap", "multical", "cmu_panoptic", "opencv_cameras", "openpose"])
def test_files_of_windows_editors(tool: str, tmp_path: Path) -> None:
    """A byte order mark and carriage returns change nothing."""
    WRITERS[tool](tmp_path, truths())
    plain = read(tmp_path)
    for file in tmp_path.iterdir():
        file.write_bytes(b"\xef\xbb\xbf" + file.read_bytes().replace(b"\n", b"\r\n"))
    marked = read(tmp_path)
    for one, other in zip(plain.cameras, marked.cameras, strict=True):
        np.testing.assert_array_equal(one.viewmat, other.viewmat)
        assert (one.name, one.lens, one.size) == (other.name, other.lens, other.size)


def test_kalibr_with_an_imu(tmp_path: Path) -> None:
    file = write_kalibr(tmp_path, truths())
    plain = read(tmp_path)
    file.write_text(f"%YAML:1.0\n---\n{file.read_text()}\nT_imu_body:\n  [1.0, 0.0, 0.0]\n")
    (tmp_path / "a_imu_chain.yaml").write_text("imu0:\n  update_rate: 200.0\n")
    found = read(tmp_path)
    assert [camera.name for camera in found.cameras] == ["cam0", "cam1", "cam2"]
    np.testing.assert_array_equal(found.cameras[2].viewmat, plain.cameras[2].viewmat)


def test_mc_calib_has_all_cameras_in_one_file(tmp_path: Path) -> None:
    text = "%YAML:1.0\n---\nnb_camera: 3\n"
    for number, truth in enumerate(truths()):
        own = opencv_matrix("camera_matrix", truth.K) + opencv_matrix("distortion_vector", truth.dist)
        own += f"distortion_type: 0\nimg_width: {WIDTH}\nimg_height: {HEIGHT}\n"
        own += "camera_group: 0\n" + opencv_matrix("camera_pose_matrix", np.linalg.inv(truth.viewmat))
        text += f"camera_{number}:\n" + "".join(f"  {line}\n" for line in own.splitlines())
    (tmp_path / "calibrated_cameras_data.yml").write_text(text)
    found = read(tmp_path)
    assert [camera.name for camera in found.cameras] == ["camera_0", "camera_1", "camera_2"]
    for truth, camera in zip(truths(), found.cameras, strict=True):
        np.testing.assert_allclose(camera.viewmat[:3, 3], truth.T, atol=1e-9)
    file = tmp_path / "calibrated_cameras_data.yml"
    file.write_text(file.read_text().replace("camera_group: 0", "camera_group: 1", 1))
    with pytest.raises(CalibrationError, match=r"data\.yml has 2 groups of cameras .*each with a world of its own"):
        read_calibration(tmp_path)


@pytest.mark.parametrize("written", ["", '"null"'])
def test_a_camera_without_a_pose_is_left_out(tmp_path: Path, caplog: pytest.LogCaptureFixture, written: str) -> None:
    """Earlier versions of caliscope write what there is not as text."""
    write_videos(tmp_path, NAMES, frames=2)
    file = write_anipose(tmp_path, truths(dist=(0, 0, 0, 0)))
    tables = file.read_text().split("\n\n")
    for key in ("rotation", "translation"):
        tables[2] = re.sub(rf"^{key} =.*\n", f"{key} = {written}\n" if written else "", tables[2], flags=re.MULTILINE)
    file.write_text("\n\n".join(tables))
    with caplog.at_level(logging.WARNING):
        check_opens(tmp_path, names=NAMES[:2])
    assert "has no pose of camera 'cam02'; left out" in caplog.text


def test_numbers_alone_are_said(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    write_videos(tmp_path, ["right_0", "right_1", "right_2"], frames=2)
    calibrated(tmp_path, truths(names=("left_2", "left_1", "left_0"), dist=(0, 0, 0, 0)))
    assert list(open_capture(tmp_path).rig) == ["right_0", "right_1", "right_2"]
    assert "cameras are matched by their numbers alone: right_0 is 'left_0'" in caplog.text
