# SPDX-License-Identifier: Apache-2.0
"""Captures of pictures or videos with a calibration that names them: a COLMAP model, or a file of another tool.

They lie where ``camera_files`` finds them. Whether a folder of pictures is of a camera or of a frame follows from the
calibration: a camera is a name that stands for one pose. Pictures that are a uniform reduction of the size that was
calibrated (``images_2``, ``images_4``, ``images_8``) are taken as that, and pictures of lenses are undistorted.
"""

import logging
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from itertools import chain
from pathlib import Path, PurePosixPath
from typing import TypeVar

import numpy as np

from structgstream.cameras import Camera, CameraRig
from structgstream.data.calibration import (
    Calibration,
    PosedCamera,
    at_picture_size,
    calibrated_camera,
    calibrated_rig,
    check_held_out,
    check_names,
    check_poses,
    listed,
)
from structgstream.data.camera_files import (
    REDUCED,
    by_stem,
    files_of,
    other_roots,
    pictures_in,
    roots_of,
    unread_files,
    videos_in,
)
from structgstream.data.images import (
    PICTURE_SUFFIXES,
    ImageSource,
    check_one_series,
    common_pictures,
    picture_size,
    read_exif,
)
from structgstream.data.lenses import LensCamera
from structgstream.data.source import FrameSource
from structgstream.data.text_files import path_parts
from structgstream.data.timeline import natural
from structgstream.data.undistortion import rectilinear, undistort
from structgstream.data.video import VideoSource, synchronised
from structgstream.data.video_index import VIDEO_SUFFIXES, scan_videos
from structgstream.errors import CalibrationError, CaptureError

log = logging.getLogger(__name__)

PICTURE_FPS = 30.0  # folders of pictures do not state a rate
OFF_CENTER, NEARLY_SAME = 0.08, 0.1
"""How far principal points lie off the middle, on average, and by how much sizes differ, both as shares, where a
calibration is hardly for these pictures."""
STILL_FRACTION, STILL_DEGREES = 0.01, 0.5  # of the rig's extent; how far estimated poses of one camera may differ

Of = TypeVar("Of")
Pictures = Mapping[str, Mapping[str, Path]]  # camera, then instant
Sizes = Mapping[str, tuple[int, int]]


def open_posed(
    path: Path,
    calibration: Calibration,
    *,
    target: Callable[[LensCamera], Camera] = rectilinear,
    complete: bool = True,
    fps: float | None = None,
) -> FrameSource:
    """The capture at ``path`` with these cameras; with the calibration's points.

    Args:
        target: chooses the pinhole to undistort a camera to, see :func:`~structgstream.data.undistortion.rectilinear`.
        complete: whether every video must be calibrated; else the others are left out with a warning.
        fps: frames a second of pictures; None for :data:`PICTURE_FPS`. Videos state theirs.

    Raises:
        CaptureError: no pictures or videos, or not of the calibrated cameras; or they cannot be read.
        CalibrationError: a camera without calibration, one that moves, or pictures of other proportions.
    """

    def pictured(root: Path, files: Pictures, *, partial: bool) -> FrameSource:
        files = _posed(files, calibration, root) if partial else files
        filmed = of_pictures(path, files, _poses(calibration, files), root=root, calibration=calibration, fps=fps)
        return undistort(*filmed, target=target)

    stills = stills_of(path)
    for root in chain(filmed_roots(path), other_roots(path)):
        if videos := videos_in(root):
            partial = not complete or calibration.unposed
            videos = _posed(videos, calibration, root) if partial else videos
            return undistort(*of_videos(path, videos, root=root, calibration=calibration), target=target)
        if folders := pictures_in(root):
            files = _layout(folders, calibration, root)
            # Else depth maps, for example, next to images/CAMERA.
            if root != path or not stills or _poses(calibration, files):
                return pictured(root, files, partial=bool(calibration.unposed))
    if stills:
        # Structure from motion often leaves out some photos.
        return pictured(stills[0][0], {name: {"0": file} for name, file in stills[0][1].items()}, partial=True)
    for root in other_roots(path, pictures=True):
        return pictured(root, _layout(pictures_in(root), calibration, root), partial=bool(calibration.unposed))
    raise NoFrames(
        f"{path} has the calibration {calibration.where} but no frames; expected images/CAMERA/FRAME.ext, "
        f"frames/FRAME/CAMERA.ext, images/CAMERA.ext, CAMERA.mp4 or CAMERA/anything.mp4{unread_files(path)}."
    )


def stills_of(path: Path) -> list[tuple[Path, dict[str, Path]]]:
    """Folders of one picture a camera, in order, with these by name."""
    known = [root for root in roots_of(path) if root == path or root.name.lower() in ("images", "image", *REDUCED)]
    return [(root, found) for root in known if (found := by_stem(files_of(root, PICTURE_SUFFIXES)))]


class NoFrames(CaptureError):
    """A folder has a calibration, and neither pictures nor videos."""


def filmed_roots(path: Path) -> list[Path]:
    """The folders to look through, in order; videos before pictures that are stills of the same cameras."""
    roots = roots_of(path)
    pictures = {root: found for root in roots if (found := pictures_in(root))}
    videos = {root: found for root in roots if (found := videos_in(root))}
    first = next((root for root in roots if root in pictures or root in videos), None)
    filmed = next(iter(videos), None)
    if filmed is None or first is None or first == filmed:
        return roots
    single = all(len(files) == 1 for files in pictures[first].values())
    if single and len(pictures[first]) > 1 and len(pictures[first]) >= len(videos[filmed]):
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


def of_videos(
    path: Path, videos: Mapping[str, Path], *, root: Path, calibration: Calibration
) -> tuple[VideoSource, Mapping[str, LensCamera]]:
    """The videos as they are, and their cameras with lenses."""
    poses = _poses(calibration, videos)
    _check(poses, videos, calibration=calibration, root=root)
    tracks = scan_videos({name: videos[name] for name in sorted(poses, key=natural)})
    filmed = _filmed(poses, {name: (track.width, track.height) for name, track in tracks.items()}, calibration)
    rig = _rig(filmed, poses, calibration, path)
    return synchronised(tracks, rig, where=path, points=calibration.points), filmed


def of_pictures(
    path: Path,
    files: Pictures,
    poses: Mapping[str, PosedCamera],
    *,
    root: Path,
    calibration: Calibration,
    fps: float | None = None,
) -> tuple[ImageSource, Mapping[str, LensCamera]]:
    """The pictures of the cameras of ``poses`` as they are, and these cameras with lenses."""
    _check(poses, files, calibration=calibration, root=root)
    held_out = set(calibration.held_out)
    names = sorted(poses, key=natural)
    for name in names:
        check_one_series(name, files[name].values())
    common, instants = common_pictures(
        {name: files[name] for name in names}, where=path, training=[name for name in names if name not in held_out]
    )
    firsts = {name: next(filter(None, pictures)) for name, pictures in common.items()}
    turns = {name: _orientation(file, poses[name], calibration) for name, file in firsts.items()}
    sizes = {name: _shown_size(file, turns[name]) for name, file in firsts.items()}
    filmed = _filmed(poses, sizes, calibration)
    rig = _rig(filmed, poses, calibration, path)
    rate = PICTURE_FPS if fps is None else fps
    return ImageSource(path.name, rig, rate, common, calibration.points, instants, turns=turns), filmed


def _shown_size(file: Path, orientation: int) -> tuple[int, int]:
    width, height = picture_size(file)
    return (height, width) if orientation >= 5 else (width, height)


def orientations(calibration: Calibration, firsts: Mapping[str, Path]) -> dict[str, int]:
    """The EXIF orientation by which each calibrated camera's pictures are turned, by its first picture."""
    return {name: _orientation(firsts[name], posed, calibration) for name, posed in _poses(calibration, firsts).items()}


def _orientation(file: Path, posed: PosedCamera, calibration: Calibration) -> int:
    """The EXIF orientation by which a camera's pictures are turned: that of the pictures that were calibrated."""
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


def _layout(folders: Pictures, calibration: Calibration, root: Path) -> Pictures:
    """Folders per camera or per frame: whichever gives every camera one pose, and the more cameras.

    Where frames and cameras have the same numbers the name of the folder that holds them decides: ``frames``.
    """
    per_frame: dict[str, dict[str, Path]] = {}
    for folder, pictures in folders.items():
        for stem, file in pictures.items() if re.search(r"\d", folder) else ():  # frames have numbers
            per_frame.setdefault(stem, {})[folder] = file
    found: list[tuple[tuple[bool, int], Pictures]] = []  # whether all have a pose, and how many
    reasons: list[CalibrationError] = []
    names = [_parts(posed.name) for posed in calibration.cameras]
    in_frames = any(len(parts) == 1 or not folders.keys().isdisjoint(parts[:-1]) for parts in names)
    layouts = (per_frame, folders) if root.name.lower() == "frames" else (folders, per_frame)
    for files in layouts if in_frames else (folders,):
        try:
            count = len(_poses(calibration, files))
            found.append(((count == len(files), count), files))
        except CalibrationError as error:
            reasons.append(error)
    (_, count), files = max(found, key=lambda candidate: candidate[0], default=((False, 0), folders))
    if not count and reasons:
        raise reasons[0]
    return files if count else folders


def _poses(calibration: Calibration, cameras: Collection[str]) -> dict[str, PosedCamera]:
    """The calibration of each camera that has one.

    Where no name is the same, a calibrated camera's may be one of the words of a file's (``take2_cam1``), or both may
    have the same numbers (``cam_1`` and ``Camera01``), provided that every file finds its own.
    """
    names = [*(posed.name for posed in calibration.cameras), *calibration.unposed]
    parts = [_parts(name) for name in names]
    found = [next((part for part in path if part in cameras), None) for path in parts]
    if any(found) or any(_parts(name) != (name,) for name in names):
        return _still(calibration, found[: len(calibration.cameras)])
    file_of = _by_word(names, cameras)
    if not file_of:
        numbered = {_number(name): name for name in cameras}
        if None in numbered or len(numbered) != len(cameras) or not {_number(name) for name in names} >= set(numbered):
            return {}
        file_of = {name: numbered[_number(name)] for name in names if _number(name) in numbered}
    return _still(calibration, [file_of.get(posed.name) for posed in calibration.cameras])


def _by_word(names: Sequence[str], files: Collection[str]) -> dict[str, str]:
    """The file of each camera whose name is a word of it; nothing when a file has none or several, or shares one."""
    words = {file: [name for name in names if name in re.split(r"[^0-9A-Za-z]+", file)] for file in files}
    found = {own[0]: file for file, own in words.items() if len(own) == 1}
    return found if len(found) == len(files) else {}


def _parts(name: str) -> tuple[str, ...]:
    """The parts of a path, without the suffix of pictures and videos."""
    *folders, last = path_parts(name) or (name,)
    return (*folders, PurePosixPath(last).stem if _is_file(last) else last)


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
        if not np.isfinite(posed.viewmat).all():
            continue  # refused where it becomes a camera
        # From the difference, which rounding in the file changes little; the trace's arc cosine turns 1e-4 into 0.6.
        turn = float(np.linalg.norm(first.viewmat[:3, :3] - posed.viewmat[:3, :3])) / np.sqrt(8)
        degrees = np.degrees(2 * np.arcsin(min(1.0, turn)))
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
    """Pictures and calibration belong together."""
    if poses:
        check_names(poses, sorted(pictured, key=natural), calibration=calibration.where, pictures=root)
        used = {posed.name for posed in poses.values()}
        unused = [posed.name for posed in calibration.cameras if posed.name not in used]
        missing = [name for name in unused if poses.keys().isdisjoint(_parts(name))]
        idle = list({_parts(name)[:-1] if _is_file(name) else name: name for name in reversed(missing)}.values())[::-1]
        others = {name: posed.name for name, posed in poses.items() if name not in (*_parts(posed.name), posed.name)}
        numbered = {name: own for name, own in others.items() if not (name.isdigit() and own.isdigit())}
        if numbered and not _by_word(list(numbered.values()), list(numbered)):
            pairs = ", ".join(f"{name} is {own!r}" for name, own in sorted(numbered.items())[:3])
            log.warning("%s: no names are the same, so cameras are matched by their numbers alone: %s", root, pairs)
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
    filmed, where = {}, calibration.where
    for name, size in sizes.items():
        posed = poses[name]
        camera = calibrated_camera(name, viewmat=posed.viewmat, K=posed.K, size=posed.size or size, where=where)
        filmed[name] = LensCamera(at_picture_size(camera, size, name=name, where=where), posed.lens)
    _warn_of_sizes(filmed, poses, where)
    return filmed


def _warn_of_sizes(filmed: Mapping[str, LensCamera], poses: Mapping[str, PosedCamera], where: Path) -> None:
    """Warns of pictures that a calibration may not be for, though their proportions are right."""
    cameras = {name: own.camera for name, own in filmed.items()}
    middles = [
        (camera.K[:2, 2] / camera.K.new_tensor([camera.width, camera.height])).tolist()
        for name, camera in cameras.items()
        if poses[name].size is None
    ]
    middle = np.mean(middles or [[0.5, 0.5]], 0)
    if middle.max() < 0.5 - OFF_CENTER or middle.min() > 0.5 + OFF_CENTER:
        log.warning(
            "%s states no size of pictures, and its principal points lie at %.0f %% of their width and %.0f %% of "
            "their height: it may be for pictures of another size; use those, or scale its intrinsics",
            where, *(100 * middle),
        )  # fmt: skip
    for name, camera in cameras.items():
        size = poses[name].size or (camera.width, camera.height)
        if camera.width != size[0] and abs(camera.width / size[0] - 1) < NEARLY_SAME:
            log.warning(
                "%s is for pictures of %dx%d pixels, those of camera %r have %dx%d, hardly another size: one may be of "
                "undistorted pictures (colmap image_undistorter), the other of those as filmed; use both of one kind",
                where, *size, name, camera.width, camera.height,
            )  # fmt: skip
            return


def _rig(
    filmed: Mapping[str, LensCamera], poses: Mapping[str, PosedCamera], calibration: Calibration, path: Path
) -> CameraRig:
    """The rig of the pictures, in which cameras are held out that the calibration does, by its names or by these."""
    calibrated = [*(posed.name for posed in calibration.cameras), *calibration.unposed]
    check_held_out(calibration.held_out, [*calibrated, *filmed], where=calibration.where)
    held_out = [name for name in filmed if not {name, poses[name].name}.isdisjoint(calibration.held_out)]
    return calibrated_rig({name: own.camera for name, own in filmed.items()}, held_out, where=path)


def filmed_by(calibration: Calibration, sizes: Sizes, *, root: Path) -> dict[str, LensCamera]:
    """The cameras of a calibration with their lenses, for pictures in ``root`` of ``sizes``, width and height.

    Raises:
        CalibrationError: it is of other cameras, of one that moves, cameras of one pose, or for pictures of
            other proportions.
    """
    poses = _poses(calibration, sizes)
    _check(poses, sizes, calibration=calibration, root=root)
    filmed = _filmed(poses, sizes, calibration)
    check_poses({name: own.camera for name, own in filmed.items()}, where=calibration.where)
    return filmed
