# SPDX-License-Identifier: Apache-2.0
"""Calibration files of other tools: a :class:`~structgstream.data.calibration.CalibrationFormat` each.

Most state OpenCV's intrinsics, distortion coefficients and poses (world to camera), under other keys. Files of OpenCV's
``FileStorage`` are read by :mod:`.opencv_cameras`, ``transforms.json`` and COLMAP models elsewhere.
"""

import re
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from structgstream.data.calibration import CalibrationFormat, NoPose, PosedCamera, common_folder, intrinsics, rigid
from structgstream.data.calibration_files.reading import (
    json_files_with,
    load_plain,
    parsed_xml,
    parsed_yaml,
    read_storage,
    recognized,
)
from structgstream.data.lenses import Lens, Pinhole, fisheye_lens, from_integer_centers, opencv_lens
from structgstream.data.text_files import Unreadable, mapping, number, pixels, read_json, read_text, read_toml, readable
from structgstream.errors import CalibrationError
from structgstream.geometry import Floats

CENTIMETRE, MILLIMETRE = 0.01, 0.001
Entries = Iterator[tuple[str, Any]]


def opencv_camera(
    name: str, viewmat: Floats, *, K: ArrayLike, dist: Any, size: Any = None, fisheye: bool = False
) -> PosedCamera:
    """A camera in OpenCV's conventions.

    Args:
        viewmat: world to camera ``[4, 4]``.
        K: intrinsics ``[3, 3]``, pixels, the top-left pixel's centre at (0, 0).
        dist: coefficients in OpenCV's order, of any shape, or of its fisheye model; None for none.
        size: width and height, pixels; None if unknown.
    """
    coefficients = [] if dist is None else np.ravel(dist).tolist()
    lens = (fisheye_lens if fisheye else opencv_lens)(coefficients)
    return PosedCamera(name, viewmat, from_integer_centers(K), None if size is None else pixels(size), lens)


# aniposelib: TOML with a table per camera, at the top or below ``cameras``. Anipose, caliscope, Pose2Sim and FreeMoCap
# write it. The unit is that of the board.


def _find_anipose(folder: Path) -> Iterator[tuple[Path, ...]]:
    for file in sorted(folder.glob("*.toml")):
        try:
            if any(_anipose_entries((file,))):
                yield (file,)
        except (OSError, ValueError):
            if "calib" in file.stem.lower():
                yield (file,)


def _named(folder: Path, *names: str) -> Iterator[tuple[Path, ...]]:
    """The files of these names in ``folder``, if the first is there."""
    if (folder / names[0]).is_file():
        yield tuple(folder / name for name in names)


def _anipose_entries(files: tuple[Path, ...]) -> Entries:
    content = read_toml(files[0])
    tables = content.get("cameras", content)
    for key, table in tables.items() if isinstance(tables, dict) else ():
        if isinstance(table, dict) and "matrix" in table:
            yield str(table.get("name", key)), table


def _anipose_camera(name: str, table: dict[str, Any]) -> PosedCamera:
    if all(table.get(key, "null") == "null" for key in ("rotation", "translation")):  # as earlier caliscopes write none
        raise NoPose
    viewmat, fisheye = rigid(table["rotation"], table["translation"]), bool(table.get("fisheye"))
    K, dist = table["matrix"], table["distortions"]
    return opencv_camera(name, viewmat, K=K, dist=dist, size=table["size"], fisheye=fisheye)


# EasyMocap and EasyVolcap, as ENeRF-Outdoor is published: intri.yml and extri.yml with ``names`` and keys per camera.

INTRINSICS, EXTRINSICS = "intri.yml", "extri.yml"
EASYMOCAP_EXPECTED = "names, K_NAME and D_NAME in intri.yml, and R_NAME or Rot_NAME and T_NAME in extri.yml"


def _easymocap_entries(files: tuple[Path, ...]) -> Entries:
    content: dict[str, Any] = {}
    for file in files:
        with readable(file, EASYMOCAP_EXPECTED):
            content |= read_storage(file)
    stated = content.get("names")
    names = [str(name) for name in stated] if isinstance(stated, list) else []
    if not all(f"K_{name}" in content for name in names):
        names = [key.removeprefix("K_") for key in content if key.startswith("K_")]
    return ((name, content) for name in names)


def _easymocap_camera(name: str, content: dict[str, Any]) -> PosedCamera:
    dist = content.get(f"D_{name}", content.get(f"dist_{name}"))
    R = content[f"Rot_{name}"] if f"Rot_{name}" in content else content[f"R_{name}"]
    size = (content.get(f"W_{name}", -1), content.get(f"H_{name}", -1))
    known_size = size if min(map(number, size)) > 0 else None
    return opencv_camera(name, rigid(R, content[f"T_{name}"]), K=content[f"K_{name}"], dist=dist, size=known_size)


# multical: calibration.json with ``cameras`` and ``camera_poses``. Poses map the rig to the camera; those of a name
# ``NAME_to_OTHER`` map the axes of OTHER to those of NAME, despite that name. Its ``--isFisheye`` shows in the shape of
# the coefficients alone: a column of four, where OpenCV's other model has a row of five or more.


def _multical_entries(files: tuple[Path, ...]) -> Entries:
    content = read_json(files[0])
    poses = _absolute_poses(content["camera_poses"])
    return ((name, (entry, poses)) for name, entry in mapping(content["cameras"]).items())


def _absolute_poses(entries: Mapping[str, Any]) -> dict[str, Floats]:
    """World to camera by name; each relative pose after the one that it refers to."""
    poses: dict[str, Floats] = {}
    remaining = mapping(entries)
    while remaining:
        ready = {key: key.split("_to_") for key in remaining if "_to_" not in key or key.split("_to_")[1] in poses}
        if not ready:
            raise Unreadable(f"the poses {', '.join(remaining)} refer to no camera that has one")
        for key, (name, *other) in ready.items():
            pose = mapping(remaining.pop(key))
            viewmat = rigid(pose["R"], pose["T"])
            poses[name] = viewmat @ poses[other[0]] if other else viewmat
    return poses


def _multical_camera(name: str, entry: tuple[dict[str, Any], Mapping[str, Floats]]) -> PosedCamera:
    camera, poses = entry
    if name not in poses:
        raise NoPose
    K, dist, size = camera["K"], camera["dist"], camera["image_size"]
    return opencv_camera(name, poses[name], K=K, dist=dist, size=size, fisheye=np.shape(dist) == (4, 1))


# Kalibr: camchain.yaml of pinholes with radtan or equidistant distortion. ``T_cn_cnm1`` maps the axes of the camera
# before to this one's; the world is the first camera. Other keys, as those of an IMU, are no camera's.

KALIBR_CAMERA = re.compile(r"cam\d+")
KALIBR_CHAIN = re.compile(r"^cam\d+\s*:[\s\S]*\bT_cn_cnm1\b|^cam\d+\s*:[\s\S]*\bcamera_model\b", re.MULTILINE)
KALIBR_LENSES: Mapping[str, Any] = {"radtan": opencv_lens, "equidistant": fisheye_lens, "none": lambda _: Pinhole()}


def _find_kalibr(folder: Path) -> Iterator[tuple[Path, ...]]:
    files = (file for file in folder.iterdir() if file.suffix.lower() in (".yaml", ".yml"))
    found = recognized(files, lambda file: "camchain" in file.stem or KALIBR_CHAIN.search(read_text(file)))
    return ((file,) for file in found)


def _kalibr_entries(files: tuple[Path, ...]) -> Entries:
    content = mapping(parsed_yaml(read_text(files[0])))
    names = [str(name) for name in content if KALIBR_CAMERA.fullmatch(str(name))]
    names.sort(key=lambda name: int(name.removeprefix("cam")))
    chain = [content[name] for name in names]
    return ((name, (files[0], chain[: position + 1])) for position, name in enumerate(names))


def _kalibr_camera(name: str, entry: tuple[Path, list[Any]]) -> PosedCamera:
    """The last camera of a chain."""
    file, chain = entry[0], [mapping(camera) for camera in entry[1]]
    viewmat = np.eye(4)
    for camera in chain[1:]:
        viewmat = np.array(camera["T_cn_cnm1"], dtype=np.float64).reshape(4, 4) @ viewmat
    K = from_integer_centers(intrinsics(*chain[-1]["intrinsics"]))
    return PosedCamera(name, viewmat, K, pixels(chain[-1]["resolution"]), _kalibr_lens(name, chain[-1], file))


def _kalibr_lens(name: str, camera: dict[str, Any], file: Path) -> Lens:
    model, distortion = str(camera["camera_model"]), str(camera.get("distortion_model", "none"))
    if model != "pinhole" or distortion not in KALIBR_LENSES:
        raise CalibrationError(
            f"Camera {name!r} of {file} is of the model {model}-{distortion}, which is not known here; calibrate it "
            "as pinhole-radtan or pinhole-equi."
        )
    return KALIBR_LENSES[distortion](camera.get("distortion_coeffs") or ())


# CMU Panoptic Studio: calibration_SEQUENCE.json, in centimetres. ``name`` is panel_node, ``type`` hd, vga or
# kinect-color. Videos are hdVideos/hd_00_00.mp4, pictures hdImgs/00_00/00_00_00000000.jpg.


def _cmu_camera(name: str, entry: dict[str, Any]) -> PosedCamera:
    file_name = f"{entry['type']}_{name}/{name}"  # of a video, or of a folder
    viewmat = rigid(entry["R"], CENTIMETRE * np.array(entry["t"], np.float64))
    return opencv_camera(file_name, viewmat, K=entry["K"], dist=entry["distCoef"], size=entry["resolution"])


# ZJU-MoCap: annots.npy, in millimetres. ``cams`` has lists K, D, R and T; ``ims`` the pictures of each instant,
# ``CAMERA/FRAME.jpg`` in the order of the cameras.


def _zju_entries(files: tuple[Path, ...]) -> Entries:
    content: dict[str, Any] = np.asarray(load_plain(files[0])).item()
    rows = zip(content["ims"][0]["ims"], *(content["cams"][key] for key in "KDRT"), strict=True)
    return ((str(picture), row) for picture, *row in rows)


def _zju_camera(name: str, row: list[Any]) -> PosedCamera:
    K, dist, R, T = row
    return opencv_camera(name, rigid(R, MILLIMETRE * np.array(T, np.float64)), K=K, dist=dist)


# Qualisys: .qca.txt, XML in millimetres, lengths on the sensor in 1/64 pixel. ``transform`` maps the world to axes x
# right, y up, z backward. The sensor counts from its border, so that the top-left pixel's centre is (0.5, 0.5).

SUBPIXELS = 64
VIDEO_MODELS = ("video", "hybrid", "none")  # a hybrid camera films markers and video


def _qualisys_entries(files: tuple[Path, ...]) -> Entries:
    (file,) = files
    cameras = parsed_xml(file.read_bytes()).iter("camera")
    video = [tag for tag in cameras if any(word in tag.get("model", "none").lower() for word in VIDEO_MODELS)]
    entries = [(tag.attrib["serial"], tag) for tag in video]
    for serial, tag in entries:
        if (rotation := tag.get("viewrotation", "0")) != "0":
            raise CalibrationError(
                f"Camera {serial!r} of {file} has pictures that are turned by {rotation} degrees, and its calibration "
                "is for those that are not; set the view rotation to 0 and export again."
            )
    return iter(entries)


def _qualisys_camera(name: str, tag: ET.Element) -> PosedCamera:
    view, pose, optics = (_attributes(tag, child) for child in ("fov_video", "transform", "intrinsic"))
    rotation = np.array([[pose[f"r{row}{column}"] for column in (1, 2, 3)] for row in (1, 2, 3)])
    position = np.array([pose["x"], pose["y"], pose["z"]]) * MILLIMETRE
    fx, fy, cx, cy = (
        optics[key] / SUBPIXELS for key in ("focalLengthU", "focalLengthV", "centerPointU", "centerPointV")
    )
    radial = [optics[f"radialDistortion{term}"] for term in (1, 2)]
    tangential = [optics[f"tangentalDistortion{term}"] for term in (1, 2)]  # the file's spelling
    return PosedCamera(
        name=name,
        viewmat=np.diag([1.0, -1.0, -1.0, 1.0]) @ rigid(rotation, -rotation @ position),
        K=intrinsics(fx, fy, cx - view["left"], cy - view["top"]),
        size=pixels((view["right"] - view["left"] + 1, view["bottom"] - view["top"] + 1)),
        lens=opencv_lens([*radial, *tangential, optics.get("radialDistortion3", 0.0)]),
    )


def _attributes(tag: ET.Element, child: str) -> dict[str, float]:
    found = tag.find(child)
    if found is None:
        raise KeyError(child)
    return {key: number(value) for key, value in found.attrib.items()}


# Projection matrices alone, [3, 4], which have intrinsics, rotation and position up to scale: a text a camera with
# twelve numbers, after the word CONTOUR where PMVS reads it (txt/00000000.txt); or cameras*.npz of IDR and NeuS.

LARGEST_TEXT = 2000  # bytes of a file of twelve numbers
MIN_FOCAL_LENGTH = 10.0  # pixels; a pose without intrinsics has 1


def _find_projections(folder: Path) -> Iterator[tuple[Path, ...]]:
    for file in sorted(folder.glob("cameras*.npz"))[-1:]:  # cameras_sphere.npz rather than cameras_large.npz
        yield (file,)
    for place in (folder, folder / "txt"):
        texts = tuple(recognized(place.glob("*.txt"), _holds_projection))
        if len(texts) > 1:
            yield texts


def _projection_entries(files: tuple[Path, ...]) -> Entries:
    if files[0].suffix == ".npz":
        with readable(files[0], "world_mat_0 and so on"), np.load(files[0], allow_pickle=False) as content:
            matrices = {key[10:]: content[key] for key in content if re.fullmatch(r"world_mat_\d+", key)}
        return iter(matrices.items())
    return ((file.stem, [number(word) for word in _words(file)]) for file in files)


def _words(file: Path) -> list[str]:
    words = read_text(file).replace(";", " ").split()
    return words[words[:1] == ["CONTOUR"] :]


def _holds_projection(file: Path) -> bool:
    return file.stat().st_size < LARGEST_TEXT and np.isfinite([number(word) for word in _words(file)]).sum() == 12


def _projection_camera(name: str, matrix: ArrayLike) -> PosedCamera:
    K, viewmat = decompose_projection(matrix)
    return PosedCamera(name, viewmat, from_integer_centers(K), None)


def decompose_projection(matrix: ArrayLike) -> tuple[Floats, Floats]:
    """Intrinsics ``[3, 3]`` and world to camera ``[4, 4]`` of ``[3, 4]`` numbers, or of the first rows of ``[4, 4]``
    (Hartley and Zisserman, section 6.2.4)."""
    P = np.ravel(np.array(matrix, np.float64))
    if P.size not in (12, 16) or not np.isfinite(P).all():
        raise Unreadable(f"a matrix of shape {np.shape(matrix)}, or with numbers that are not finite")
    P = P[:12].reshape(3, 4)
    determinant = float(np.linalg.det(P[:, :3] / max(np.abs(P[:, :3]).max(), 1e-300)))
    if abs(determinant) < 1e-15:
        raise Unreadable("a matrix of no camera: its first three columns have no inverse")
    P = P * np.sign(determinant)
    # The upper triangle comes first: a decomposition of rows from the last to the first (RQ by QR).
    q, r = np.linalg.qr(np.flipud(P[:, :3]).T)
    K, rotation = np.fliplr(np.flipud(r.T)), np.flipud(q.T)
    signs = np.sign(np.diag(K))
    K, rotation = K * signs, signs[:, None] * rotation
    viewmat = rigid(rotation, np.linalg.solve(K, P[:, 3]))
    K = K / K[2, 2]
    if min(K[0, 0], K[1, 1]) < MIN_FOCAL_LENGTH:
        raise Unreadable("a pose without intrinsics, in place of a projection matrix")
    return K, viewmat


ANIPOSE = CalibrationFormat(
    _find_anipose,
    _anipose_entries,
    _anipose_camera,
    "a table per camera with name, size, matrix, distortions, rotation and translation, as aniposelib writes it",
    turned_by_exif=True,
)
EASYMOCAP = CalibrationFormat(
    lambda folder: _named(folder, INTRINSICS, EXTRINSICS),
    _easymocap_entries,
    _easymocap_camera,
    EASYMOCAP_EXPECTED,
    turned_by_exif=True,
)
MULTICAL = CalibrationFormat(
    partial(json_files_with, key="camera_poses"),
    _multical_entries,
    _multical_camera,
    "cameras with image_size, K and dist, and camera_poses with R and T, as multical writes it",
    turned_by_exif=True,
)
KALIBR = CalibrationFormat(
    _find_kalibr,
    _kalibr_entries,
    _kalibr_camera,
    "cam0, cam1, ... with camera_model, intrinsics, distortion_model, distortion_coeffs, resolution and T_cn_cnm1",
)
CMU_PANOPTIC = CalibrationFormat(
    partial(json_files_with, key="distCoef"),
    lambda files: ((str(entry["name"]), entry) for entry in read_json(files[0])["cameras"]),
    _cmu_camera,
    "a list of cameras with name, type, resolution, K, distCoef, R and t, as the Panoptic Studio has it",
)
QUALISYS = CalibrationFormat(
    lambda folder: ((file,) for file in sorted(folder.glob("*.qca.txt"))),
    _qualisys_entries,
    _qualisys_camera,
    "cameras of video with fov_video, transform and intrinsic, as Qualisys Track Manager exports it",
)
ZJU_MOCAP = CalibrationFormat(
    lambda folder: _named(folder, "annots.npy"),
    _zju_entries,
    _zju_camera,
    "a dictionary with cams (lists K, D, R and T) and ims, as ZJU-MoCap has it",
)
PROJECTIONS = CalibrationFormat(
    _find_projections,
    _projection_entries,
    _projection_camera,
    "a projection matrix of 3x4 numbers, pixels of the pictures",
    where=common_folder,
)
