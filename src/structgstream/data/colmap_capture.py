# SPDX-License-Identifier: Apache-2.0
"""Captures calibrated by a COLMAP model: pictures or videos, one folder per camera or one per frame.

::

    images/CAMERA/FRAME.ext     one folder per camera
    frames/FRAME/CAMERA.ext     one folder per frame
    CAMERA.mp4                  one video per camera, in the folder itself or in videos/

beside ``sparse/0``, ``sparse`` or model files in the folder itself, where folders of pictures may lie too.
Which of the two layouts it is follows from the model: a camera is a name that stands for one pose.
"""

from collections.abc import Collection, Mapping
from pathlib import Path, PurePosixPath

import numpy as np

from structgstream.cameras import CameraRig
from structgstream.data.calibration import calibrated_camera, calibrated_rig, check_names
from structgstream.data.colmap import ColmapImage, ColmapModel, find_model, read_model
from structgstream.data.images import PICTURE_SUFFIXES, ImageSource, common_pictures
from structgstream.data.source import FrameSource
from structgstream.data.timeline import natural
from structgstream.data.video import VIDEO_SUFFIXES, scan_videos, synchronised
from structgstream.errors import CalibrationError, CaptureError

PICTURE_FPS = 30.0  # folders of pictures do not state a rate
STILL_FRACTION, STILL_DEGREES = (
    0.01,
    0.5,
)  # of the rig's extent; how far estimated poses of one camera may differ

Pictures = Mapping[str, Mapping[str, Path]]  # camera, then instant


def recognises_colmap(path: Path) -> bool:
    """Whether the folder has a COLMAP model."""
    return find_model(path) is not None


def open_colmap(path: Path) -> FrameSource:
    """The capture at ``path``; nothing is held out, and the model's points come along.

    Raises:
        CaptureError: no pictures or videos beside the model, or not of the model's cameras.
        CalibrationError: a broken or distorted model, a camera without calibration, or one that moves.
    """
    folder = find_model(path)
    if folder is None:
        raise CaptureError(f"{path} has no COLMAP model; expected cameras, images and points3D in sparse/0.")
    model = read_model(folder)
    points = model.points if len(model.points) else None
    for root in (path / "frames", path / "images", path / "videos", path):
        if videos := _videos(root):
            rig = _rig(_poses(model, videos), videos, root, model, path)
            return synchronised(scan_videos({name: videos[name] for name in rig}), rig, where=path, points=points)
        if folders := _folders(root):
            files, poses = _layout(folders, model, root)
            rig = _rig(poses, files, root, model, path)
            common = common_pictures({name: files[name] for name in rig}, where=path)
            return ImageSource(path.name, rig, PICTURE_FPS, common, points)
    raise CaptureError(
        f"{path} has a COLMAP model but no frames; expected images/CAMERA/FRAME.ext, frames/FRAME/CAMERA.ext "
        "or one video per camera."
    )


def _videos(root: Path) -> dict[str, Path]:
    if not root.is_dir():
        return {}
    return {file.stem: file for file in root.iterdir() if file.suffix.lower() in VIDEO_SUFFIXES}


def _folders(root: Path) -> dict[str, dict[str, Path]]:
    """Folders below ``root`` that hold pictures: folder name, then file stem."""
    if not root.is_dir():
        return {}
    folders = {}
    for folder in root.iterdir():
        if folder.is_dir() and folder.name not in ("images", "frames", "videos"):
            pictures = {file.stem: file for file in folder.iterdir() if file.suffix.lower() in PICTURE_SUFFIXES}
            if pictures:
                folders[folder.name] = pictures
    return folders


def _layout(folders: Pictures, model: ColmapModel, root: Path) -> tuple[Pictures, dict[str, ColmapImage]]:
    """Folders per camera or per frame: whichever gives every camera one pose, and the more cameras."""
    per_frame: dict[str, dict[str, Path]] = {}
    for folder, pictures in folders.items():
        for stem, file in pictures.items():
            per_frame.setdefault(stem, {})[folder] = file
    found: list[tuple[Pictures, dict[str, ColmapImage]]] = []
    reasons: list[CalibrationError] = []
    for files in (folders, per_frame):
        try:
            found.append((files, _poses(model, files)))
        except CalibrationError as error:
            reasons.append(error)
    files, poses = max(found, key=lambda candidate: len(candidate[1]), default=({}, {}))
    if poses:
        return files, poses
    if reasons:
        raise reasons[0]
    raise CalibrationError(
        f"No picture of {model.folder} belongs to the pictures in {root}: the model names "
        f"{model.images[0].name if model.images else 'nothing'!r}; expected the camera's name in it."
    )


def _poses(model: ColmapModel, cameras: Collection[str]) -> dict[str, ColmapImage]:
    """The model's picture of each camera that it has.

    Raises:
        CalibrationError: pictures of one camera have different poses.
    """
    centers = np.array([_center(image) for image in model.images]).reshape(-1, 3)
    extent = float(np.linalg.norm(np.ptp(centers, axis=0))) if len(centers) else 0.0
    found: dict[str, ColmapImage] = {}
    for image in model.images:
        parts = PurePosixPath(image.name).with_suffix("").parts
        name = next((part for part in parts if part in cameras), None)
        if name is None:
            continue
        first = found.setdefault(name, image)
        turn = np.trace(first.viewmat[:3, :3] @ image.viewmat[:3, :3].T)
        degrees = np.degrees(np.arccos(np.clip((turn - 1) / 2, -1, 1)))
        shift = float(np.linalg.norm(_center(first) - _center(image)))
        if shift > STILL_FRACTION * extent or degrees > STILL_DEGREES:
            raise CalibrationError(
                f"Camera {name!r} moves in {model.folder}: {first.name!r} and {image.name!r} lie {shift:.3g} "
                f"units and {degrees:.2g} degrees apart; expected cameras that stand still."
            )
    return found


def _center(image: ColmapImage) -> np.ndarray:
    return -image.viewmat[:3, :3].T @ image.viewmat[:3, 3]


def _rig(
    poses: Mapping[str, ColmapImage], pictures: Collection[str], root: Path, model: ColmapModel, path: Path
) -> CameraRig:
    check_names(poses, sorted(pictures, key=natural), calibration=model.folder, pictures=root)
    cameras = {
        name: calibrated_camera(
            name,
            viewmat=poses[name].viewmat,
            K=poses[name].camera.K,
            width=poses[name].camera.width,
            height=poses[name].camera.height,
            where=model.folder,
        )
        for name in sorted(poses, key=natural)
    }
    return calibrated_rig(cameras, (), where=path)
