# SPDX-License-Identifier: Apache-2.0
"""Captures of pictures or videos beside a calibration that names them: a COLMAP model, or a file of another tool.

::

    images/CAMERA/FRAME.ext     one folder per camera
    frames/FRAME/CAMERA.ext     one folder per frame
    CAMERA.mp4                  one video per camera, in the folder itself or in videos/
    images/CAMERA.ext           one picture per camera: a capture of one frame

Folders of pictures may lie in the capture itself, too. Which of the two layouts it is follows from the calibration: a
camera is a name that stands for one pose. Pictures that are a uniform reduction of the size that was calibrated
(``images_2``, ``images_4``, ``images_8``) are taken as that, and pictures of lenses are undistorted.
"""

import logging
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import TypeVar

import numpy as np

from structgstream.cameras import Camera, CameraRig
from structgstream.data.calibration import calibrated_camera, calibrated_rig, check_names, listed
from structgstream.data.exif import read_exif
from structgstream.data.folder_files import REPORT, by_stem, files_of
from structgstream.data.images import PICTURE_SUFFIXES, ImageSource, common_pictures
from structgstream.data.lenses import LensCamera
from structgstream.data.picture_size import picture_size
from structgstream.data.posed import Calibration, PosedCamera
from structgstream.data.rectilinear import rectilinear
from structgstream.data.source import FrameSource
from structgstream.data.timeline import natural
from structgstream.data.undistortion import undistort
from structgstream.data.video import VideoSource, synchronised
from structgstream.data.video_index import VIDEO_SUFFIXES, scan_videos
from structgstream.errors import CalibrationError, CaptureError

log = logging.getLogger(__name__)

PICTURE_FPS = 30.0  # folders of pictures do not state a rate
STILL_FRACTION, STILL_DEGREES = 0.01, 0.5  # of the rig's extent; how far estimated poses of one camera may differ
REDUCED = ("images_2", "images_4", "images_8")
# In the order in which they are looked through; the last but one are those of the CMU Panoptic toolbox.
ROOTS = ("frames", "images", "videos", "hdVideos", "hdImgs", "", *REDUCED)
NO_CAMERAS = (*ROOTS, "masks", REPORT)  # of ``masks.py`` and of the check: no camera and no frame

Of = TypeVar("Of")
Pictures = Mapping[str, Mapping[str, Path]]  # camera, then instant
Sizes = Mapping[str, tuple[int, int]]


def open_posed(
    path: Path,
    calibration: Calibration,
    *,
    target: Callable[[LensCamera], Camera] = rectilinear,
    complete: bool = True,
) -> FrameSource:
    """The capture at ``path`` with these cameras; the calibration's points come along.

    Args:
        path: the folder with pictures or videos.
        calibration: its cameras.
        target: chooses the pinhole to undistort a camera to, see :func:`~structgstream.data.rectilinear.rectilinear`.
        complete: whether every video must be calibrated; else the others are left out with a warning.

    Raises:
        CaptureError: no pictures or videos, or not of the calibrated cameras.
        CalibrationError: a camera without calibration, one that moves, or pictures of other proportions.
    """
    for root in _roots(path):
        if videos := _videos(root):
            videos = videos if complete else _posed(videos, calibration, root)
            return undistort(*_of_videos(path, videos, root=root, calibration=calibration), target=target)
        if folders := _folders(root):
            files, poses = _layout(folders, calibration, root)
            return undistort(*of_pictures(path, files, poses, root=root, calibration=calibration), target=target)
    for root in (path / name for name in ("images", *REDUCED, "")):
        if stills := {name: {"0": file} for name, file in _files(root, PICTURE_SUFFIXES).items()}:
            stills = _posed(stills, calibration, root)  # structure from motion often leaves out some photos
            poses = _poses(calibration, stills)
            return undistort(*of_pictures(path, stills, poses, root=root, calibration=calibration), target=target)
    raise CaptureError(
        f"{path} has the calibration {calibration.where} but no frames; expected images/CAMERA/FRAME.ext, "
        "frames/FRAME/CAMERA.ext, images/CAMERA.ext or one video per camera."
    )


def _roots(path: Path) -> list[Path]:
    """The folders to look through, in order; videos before pictures that are stills of the same cameras."""
    roots = [path / name for name in ROOTS]
    stills = next(
        (root for root in roots if (own := _folders(root)) and all(len(files) == 1 for files in own.values())), None
    )
    first = next((root for root in roots if _folders(root) or _videos(root)), None)
    filmed = next((root for root in roots if _videos(root)), None)
    if filmed is None or first is None or first == filmed:
        return roots
    if first == stills and (len(_folders(first)) > 1 and len(_folders(first)) >= len(_videos(filmed))):
        log.warning("%s has one picture of each camera in %s; the videos in %s are read", path.name, first, filmed)
        return [filmed, *roots]
    log.warning("%s has pictures in %s and videos in %s; the pictures are read", path.name, first, filmed)
    return roots


def _posed(files: Mapping[str, Of], calibration: Calibration, root: Path) -> Mapping[str, Of]:
    """Those that the calibration has a pose for, with a warning; all when it has none of them."""
    poses = _poses(calibration, files)
    unknown = sorted(files.keys() - poses.keys(), key=natural)
    if not (poses and unknown):
        return files
    log.warning("%s has no pose of %s of %s; left out", calibration.where, listed(unknown), root)
    return {name: file for name, file in files.items() if name in poses}


def _of_videos(
    path: Path, videos: Mapping[str, Path], *, root: Path, calibration: Calibration
) -> tuple[VideoSource, Mapping[str, LensCamera]]:
    """The videos as they are, and their cameras with lenses."""
    poses = _poses(calibration, videos)
    _check(poses, videos, calibration=calibration, root=root)
    tracks = scan_videos({name: videos[name] for name in sorted(poses, key=natural)})
    filmed = _filmed(poses, {name: (track.width, track.height) for name, track in tracks.items()}, calibration)
    rig = _rig(filmed, calibration, path)
    return synchronised(tracks, rig, where=path, points=calibration.points), filmed


def of_pictures(
    path: Path, files: Pictures, poses: Mapping[str, PosedCamera], *, root: Path, calibration: Calibration
) -> tuple[ImageSource, Mapping[str, LensCamera]]:
    """The pictures of the cameras of ``poses`` as they are, and these cameras with lenses.

    Raises:
        CaptureError: a picture is missing or cannot be read.
        CalibrationError: ``files`` are of other cameras, or have other proportions.
    """
    _check(poses, files, calibration=calibration, root=root)
    held_out = set(calibration.held_out)
    names = sorted(poses, key=natural)
    common = common_pictures(
        {name: files[name] for name in names}, where=path, training=[name for name in names if name not in held_out]
    )
    firsts = {name: next(filter(None, pictures)) for name, pictures in common.files.items()}
    turns = {name: _orientation(file, poses[name], calibration) for name, file in firsts.items()}
    sizes = {name: _shown_size(file, turns[name]) for name, file in firsts.items()}
    filmed = _filmed(poses, sizes, calibration)
    rig = _rig(filmed, calibration, path)
    source = ImageSource(path.name, rig, PICTURE_FPS, common.files, calibration.points, common.instants, turns=turns)
    return source, filmed


def _shown_size(file: Path, orientation: int) -> tuple[int, int]:
    width, height = picture_size(file)
    return (height, width) if orientation >= 5 else (width, height)


def _orientation(file: Path, posed: PosedCamera, calibration: Calibration) -> int:
    """The EXIF orientation by which a camera's pictures are turned: that of the pictures that were calibrated.

    Raises:
        CalibrationError: neither the calibration nor the size of the pictures decides.
    """
    orientation = read_exif(file).orientation
    if orientation == 1:
        return 1
    stored = picture_size(file)
    shown = _shown_size(file, orientation)
    if posed.size is not None and stored != shown:
        fits = [abs(size[1] - posed.size[1] * size[0] / posed.size[0]) <= 1 for size in (stored, shown)]
        if fits[0] != fits[1]:
            return orientation if fits[1] else 1
    if calibration.turned_by_exif is None:
        raise CalibrationError(
            f"The picture {file} has the EXIF orientation {orientation}, and {calibration.where} does not say whether "
            "it is for the stored or for the turned pictures; export the pictures of all cameras upright, without that "
            "tag, as they were when they were calibrated."
        )
    return orientation if calibration.turned_by_exif else 1


def _files(root: Path, suffixes: Collection[str]) -> dict[str, Path]:
    """Files of these kinds in a folder, by stem.

    Raises:
        CaptureError: two have one.
    """
    if not root.is_dir():
        return {}
    return by_stem(files_of(root, suffixes))


def _videos(root: Path) -> dict[str, Path]:
    return _files(root, VIDEO_SUFFIXES)


def _folders(root: Path) -> dict[str, dict[str, Path]]:
    """Folders below ``root`` that hold pictures: folder name, then file stem."""
    if not root.is_dir():
        return {}
    folders = (folder for folder in root.iterdir() if folder.is_dir() and folder.name not in NO_CAMERAS)
    return {folder.name: pictures for folder in folders if (pictures := _files(folder, PICTURE_SUFFIXES))}


def _layout(folders: Pictures, calibration: Calibration, root: Path) -> tuple[Pictures, dict[str, PosedCamera]]:
    """Folders per camera or per frame: whichever gives every camera one pose, and the more cameras."""
    per_frame: dict[str, dict[str, Path]] = {}
    for folder, pictures in folders.items():
        for stem, file in pictures.items():
            per_frame.setdefault(stem, {})[folder] = file
    found: list[tuple[Pictures, dict[str, PosedCamera]]] = []
    reasons: list[CalibrationError] = []
    for files in (folders, per_frame):
        try:
            found.append((files, _poses(calibration, files)))
        except CalibrationError as error:
            reasons.append(error)
    files, poses = max(found, key=lambda candidate: len(candidate[1]), default=({}, {}))
    if not poses and reasons:
        raise reasons[0]
    return (files, poses) if poses else (folders, {})


def _poses(calibration: Calibration, cameras: Collection[str]) -> dict[str, PosedCamera]:
    """The calibration of each camera that has one.

    Where no name is the same, a calibrated camera's may be one of the words of a file's (``take2_cam1``), or both may
    have the same numbers (``cam_1`` and ``Camera01``), provided that every file finds its own.

    Raises:
        CalibrationError: pictures of one camera have different poses.
    """
    parts = [_parts(posed.name) for posed in calibration.cameras]
    found = [next((part for part in path if part in cameras), None) for path in parts]
    if any(found) or any(_parts(posed.name) != (posed.name,) for posed in calibration.cameras):
        return _still(calibration, found)
    file_of = _by_word([posed.name for posed in calibration.cameras], cameras)
    if not file_of:
        numbered = {_number(name): name for name in cameras}
        if None in numbered or len(numbered) != len(cameras) or {_number(name) for (name,) in parts} != set(numbered):
            return {}
        file_of = {name: numbered[_number(name)] for (name,) in parts}
        pairs = ", ".join(f"{name!r} is {file!r}" for name, file in list(file_of.items())[:4])
        log.warning(
            "The cameras of %s have other names than the files and are matched by number: %s", calibration.where, pairs
        )
    return _still(calibration, [file_of.get(posed.name) for posed in calibration.cameras])


def _by_word(names: Sequence[str], files: Collection[str]) -> dict[str, str]:
    """The file of each camera whose name is a word of it; nothing when a file has none or several, or shares one."""
    words = {file: [name for name in names if name in re.split(r"[^0-9A-Za-z]+", file)] for file in files}
    found = {own[0]: file for file, own in words.items() if len(own) == 1}
    return found if len(found) == len(files) else {}


def _parts(name: str) -> tuple[str, ...]:
    """The parts of a path, without the suffix of pictures and videos."""
    path = PurePosixPath(name)
    return (path.with_suffix("") if _is_file(name) else path).parts


def _is_file(name: str) -> bool:
    """Whether a calibration names a picture or video here, rather than a camera."""
    return PurePosixPath(name).suffix.lower() in PICTURE_SUFFIXES | VIDEO_SUFFIXES


def _number(name: str) -> tuple[int, ...] | None:
    """The numbers in a name, which ``cam_1``, ``Cam01`` and ``1`` share."""
    return tuple(int(digits) for digits in re.findall(r"\d+", name)) or None


def _still(calibration: Calibration, names: Sequence[str | None]) -> dict[str, PosedCamera]:
    """The first pose of each camera of ``names``, which all others of it must agree with."""
    centers = np.array([camera.center for camera in calibration.cameras]).reshape(-1, 3)
    extent = float(np.linalg.norm(np.ptp(centers, axis=0))) if len(centers) else 0.0
    found: dict[str, PosedCamera] = {}
    for name, posed in zip(names, calibration.cameras, strict=True):
        if name is None:
            continue
        first = found.setdefault(name, posed)
        turn = np.trace(first.viewmat[:3, :3] @ posed.viewmat[:3, :3].T)
        degrees = np.degrees(np.arccos(np.clip((turn - 1) / 2, -1, 1)))
        shift = float(np.linalg.norm(first.center - posed.center))
        if shift > STILL_FRACTION * extent or degrees > STILL_DEGREES:
            raise CalibrationError(
                f"Camera {name!r} moves in {calibration.where}: {first.name!r} and {posed.name!r} lie {shift:.3g} "
                f"units and {degrees:.2g} degrees apart; expected cameras that stand still."
            )
    return found


def _check(
    poses: Mapping[str, PosedCamera], pictured: Collection[str], *, calibration: Calibration, root: Path
) -> None:
    """Pictures and calibration belong together.

    Raises:
        CalibrationError: they do not.
    """
    if poses:
        check_names(poses, sorted(pictured, key=natural), calibration=calibration.where, pictures=root)
        used = {posed.name for posed in poses.values()}
        idle = [posed.name for posed in calibration.cameras if posed.name not in used and not _is_file(posed.name)]
        if idle:
            log.warning("%s has no pictures of %s of %s; left out", root, listed(idle), calibration.where)
        return
    first = calibration.cameras[0].name if calibration.cameras else "nothing"
    raise CalibrationError(
        f"No camera of {calibration.where} belongs to the pictures in {root}: the one names {first!r}, the others "
        f"{next(iter(pictured), 'nothing')!r}; expected the camera's name in both."
    )


def _filmed(poses: Mapping[str, PosedCamera], sizes: Sizes, calibration: Calibration) -> dict[str, LensCamera]:
    """Every camera at the size of its pictures, in the order of ``sizes``."""
    return {
        name: LensCamera(_sized(name, poses[name], sizes[name], calibration.where), poses[name].lens) for name in sizes
    }


def _sized(name: str, posed: PosedCamera, size: tuple[int, int], where: Path) -> Camera:
    width, height = posed.size or size
    camera = calibrated_camera(name, viewmat=posed.viewmat, K=posed.K, width=width, height=height, where=where)
    if abs(size[1] - height * size[0] / width) > 1:
        raise CalibrationError(
            f"The pictures of camera {name!r} have {size[0]}x{size[1]} pixels, {where} is for {width}x{height}: other "
            "proportions, so they are not a reduction; use pictures of the mode that was calibrated, or calibrate it."
        )
    return camera.resized(*size)


def _rig(filmed: Mapping[str, LensCamera], calibration: Calibration, path: Path) -> CameraRig:
    held_out = [name for name in calibration.held_out if name in filmed]
    return calibrated_rig({name: own.camera for name, own in filmed.items()}, held_out, where=path)


def filmed_by(calibration: Calibration, sizes: Sizes, *, root: Path) -> dict[str, LensCamera]:
    """The cameras of a calibration with their lenses, at the size of their pictures.

    Args:
        calibration: of at least these cameras.
        sizes: name of a camera to the width and height of its pictures, pixels.
        root: where the pictures lie, for messages.

    Raises:
        CalibrationError: it is of other cameras, of one that moves, or for pictures of other proportions.
    """
    poses = _poses(calibration, sizes)
    _check(poses, sizes, calibration=calibration, root=root)
    return _filmed(poses, sizes, calibration)
