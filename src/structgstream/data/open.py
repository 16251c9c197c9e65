# SPDX-License-Identifier: Apache-2.0
"""Opens a capture from a folder of any supported layout, and chooses the camera to hold out where none is stated.

A calibration is COLMAP's, transforms.json or a file of another tool, in the folder or one below: tools separate it from
the videos. Pose2Sim has ``calibration/Calib.toml`` next to ``videos/``, caliscope ``camera_array.toml`` above
``recordings/TAKE/``, 3DGStream the model of COLMAP in the folder of the first frame. One that is broken or refused, or
several that differ, are a ``CalibrationError``.
"""

import logging
import math
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Literal

import numpy as np

from structgstream.cameras import CameraRig, check_rig
from structgstream.data import transforms
from structgstream.data.calibration import Calibration, alignment, with_near
from structgstream.data.calibration_files import tools
from structgstream.data.calibration_files.opencv_cameras import OPENCV_CAMERAS
from structgstream.data.camera_files import (
    NO_CAMERAS,
    ROOTS,
    files_of,
    folders_of,
    has_files,
    has_frames,
    pictures_in,
    roots_of,
    unread_files,
    videos_in,
)
from structgstream.data.camera_spacing import best_surrounded
from structgstream.data.colmap import find_model, read_model
from structgstream.data.dataset_layouts import (
    CAMERAS_FILE,
    MODELS_FILE,
    POSES,
    TRAIN,
    open_immersive,
    open_json_videos,
    open_n3dv,
    open_panoptic,
)
from structgstream.data.images import PICTURE_SUFFIXES
from structgstream.data.masks import masks_folder, with_masks
from structgstream.data.posed_capture import NoFrames, open_posed
from structgstream.data.prepared import open_prepared, read_prepared, recognizes_prepared
from structgstream.data.roving import with_roving
from structgstream.data.source import FrameSource, WithoutPoints, WithRig, resized, section
from structgstream.errors import CalibrationError, CaptureError, ConfigError, StructGStreamError

log = logging.getLogger(__name__)

PICKLES = (".pickle", ".pkl")
SAME_ROTATION, SAME_SHARE, SAME_PIXELS = 1e-3, 0.01, 1.0
"""How far two files of one calibration differ: entries of rotations, shares of the rig's extent, pixels of K."""


CALIBRATION_FORMATS = (
    tools.ANIPOSE,
    tools.EASYMOCAP,
    tools.MULTICAL,
    tools.KALIBR,
    tools.CMU_PANOPTIC,
    tools.QUALISYS,
    tools.ZJU_MOCAP,
    tools.PROJECTIONS,
    OPENCV_CAMERAS,
)
"""The other tools' files, in any order: all that are found are read, and must agree.

What reads pictures with OpenCV turns them as their EXIF orientation states."""


def read_calibration(folder: Path, file: Path | None = None) -> Calibration | None:
    """The calibration in a folder, of COLMAP, transforms.json or another tool, in this order; None without any."""
    model, files = find_model(folder), transforms.find(folder)
    if model is not None and (file is None or file.parent == model):
        return read_model(model)
    if files and (file is None or file in files):
        return transforms.read(files)
    found = [(own, files) for own in CALIBRATION_FORMATS for files in own.find(folder)]
    read = [own.read(files) for own, files in found if file is None or file in files]
    if different := [other for other in read[1:] if not _agree(read[0], other)]:
        raise CalibrationError(
            f"{folder} has several calibrations that differ, {read[0].where.name} and "
            f"{', '.join(other.where.name for other in different[:3])}; expected that of this take alone: move the "
            "others out of the folder (prepare takes one by --calibration FILE)."
        )
    if read:
        return read[0]
    if pickles := [pickle for pickle in _pickles(folder) if file in (None, pickle)]:
        raise CalibrationError(
            f"{pickles[0]} is a pickle, and opening it could run any program; it is refused. "
            "Convert it, with a program that you trust, to one of the formats of docs/captures.md."
        )
    return None


def has_calibration(folder: Path) -> bool:
    """Whether :func:`read_calibration` finds or refuses one."""
    known = find_model(folder) or transforms.find(folder) or any(any(own.find(folder)) for own in CALIBRATION_FORMATS)
    return bool(known or _pickles(folder))


def calibration_below(path: Path) -> Path | None:
    """The one folder in ``path`` that holds the calibration of what was filmed elsewhere in ``path``; None for none.

    It may lie one deeper, as EasyVolcap's ``optimized/cameras``.
    """
    inner = inner_folders(path)
    found = list(filter(_is_calibration, inner))
    if not found and has_frames(path):
        found = [own for folder in inner if not has_files(folder) for own in folders_of(folder) if _is_calibration(own)]
    frames = pictures_in(path)
    if found and all(folder.name in frames for folder in found):
        return found[0]  # of the first frame, as 3DGStream has it
    if len(found) > 1:
        names = ", ".join(folder.name for folder in found[:4])
        raise CalibrationError(
            f"{path} has calibrations in several folders ({names}); expected one: move the others out of it."
        )
    return found[0] if found else None


def inner_folders(path: Path) -> list[Path]:
    """The folders in ``path`` that may hold calibrations, in natural order."""
    return folders_of(path, without={*NO_CAMERAS, "sparse", "sparse_"} - {"calibration"})


def _is_calibration(folder: Path) -> bool:
    """Whether a folder holds a calibration, and no frames but what it was made from."""
    if not has_calibration(folder):
        return False
    if "calib" in folder.name.lower():
        return True
    roots = roots_of(folder)
    if any(len(videos_in(root)) > 1 or len(pictures_in(root)) > 1 for root in roots):
        return False
    siblings = pictures_in(folder.parent)
    is_frame = folder.name in siblings and len(siblings) > 1
    stills = [root for root in roots if root == folder or root.name.lower() == "images"]
    return is_frame or not any(files_of(root, PICTURE_SUFFIXES) for root in stills)


def _pickles(path: Path) -> list[Path]:
    return sorted(file for file in path.iterdir() if file.suffix.lower() in PICKLES)


def _agree(a: Calibration, b: Calibration) -> bool:
    """Whether two calibrations have the same cameras up to a motion of the world and its unit of length."""
    first, second = ({camera.name: camera for camera in own.cameras} for own in (a, b))
    if first.keys() != second.keys():
        return False
    poses = [{name: camera.viewmat for name, camera in own.items()} for own in (first, second)]
    fitted = alignment(*poses)
    pairs = [(camera, second[name]) for name, camera in first.items()]
    extent = float(np.linalg.norm(np.ptp([other.center for _, other in pairs], axis=0))) or 1.0
    return all(
        np.abs(camera.viewmat[:3, :3] @ fitted.rotation.T - other.viewmat[:3, :3]).max() < SAME_ROTATION
        and np.abs(fitted.points(camera.center) - other.center).max() < SAME_SHARE * extent
        and np.abs(camera.K - other.K).max() < SAME_PIXELS
        for camera, other in pairs
    )


LAYOUTS_HELP = """Supported layouts:
  prepared         capture.json, as structgstream prepare writes it: make one from videos without calibration
  PanopticSports   train_meta.json, test_meta.json, ims/CAMERA/FRAME.jpg
  videos + JSON    cameras.json, CAMERA.mp4
  Neural 3D Video  poses_bounds.npy, camXX.mp4 (Meet Room: cam_X.mp4), with or without a COLMAP model
  Immersive        models.json, camera_NNNN.mp4, of fisheye lenses
  COLMAP           sparse/N/cameras, images, points3D (.bin or .txt), with images/CAMERA/FRAME.ext,
                   frames/FRAME/CAMERA.ext, CAMERA.mp4, or images/CAMERA.ext for one frame
  transforms.json  of Blender, instant-ngp, nerfstudio, with pictures as COLMAP or with a time each
  other tools      calibration of aniposelib, EasyMocap, multical, Kalibr, CMU Panoptic, Qualisys, ZJU-MoCap or
                   OpenCV, with pictures or videos as COLMAP
A calibration may lie one folder below, as calibration/ beside videos/; so may the whole capture, as COLMAP's dense/."""

AUTO = "auto"
PARTS = frozenset({*ROOTS, "sparse", "sparse_", "calibration"})
"""Names of folders of a capture, in lower case."""
CALIBRATION_SUFFIXES = frozenset({".json", ".npy", ".npz", ".toml", ".xml", ".yaml", ".yml"})


def open_calibrated(path: Path) -> FrameSource:
    """Pictures or videos with the calibration in the same folder, or one folder below."""
    folder = path if has_calibration(path) else calibration_below(path)
    calibration = None if folder is None else read_calibration(folder)
    assert calibration is not None, "it was recognised"
    return open_posed(path, calibration)


CAPTURE_LAYOUTS: tuple[tuple[Callable[[Path], object], Callable[[Path], FrameSource]], ...] = (
    (recognizes_prepared, open_prepared),
    (lambda path: (path / TRAIN).is_file(), open_panoptic),
    (lambda path: (path / CAMERAS_FILE).is_file(), open_json_videos),
    (lambda path: (path / POSES).is_file(), open_n3dv),
    (lambda path: (path / MODELS_FILE).is_file(), open_immersive),
    (find_model, open_calibrated),
    (transforms.find, transforms.open_transforms),
    (has_calibration, open_calibrated),
    (calibration_below, open_calibrated),
)
"""Whether a folder has a layout, and what opens it. The first that recognises the folder opens it.

A new layout goes ahead of ``find_model``, among those that are recognised by a file that no other layout has: a capture
often has a COLMAP model or another calibration besides (Neural 3D Video does), and the later entries would open it
without what its own file states. ``prepared`` stays first: a folder that ``structgstream prepare`` wrote into still has
the files that it was prepared from. The last entry looks one folder below and stays last.
``LAYOUTS_HELP`` lists the layouts for users."""


def open_capture(
    path: Path | str,
    *,
    held_out: tuple[str, ...] | Literal["auto"] | None = None,
    scale: float = 1.0,
    start: int = 0,
    frames: int | None = None,
    near: float | None = None,
    every: int = 1,
    roving: bool = True,
) -> FrameSource:
    """Opens the capture in a folder, recognising its layout.

    Args:
        path: the folder.
        held_out: names of the cameras to keep from training; None for those that the layout holds out; "auto" for the
            one best surrounded by others (:func:`~structgstream.data.camera_spacing.best_surrounded`).
        scale: size of the pictures relative to the stored ones, in (0, 1].
        start: first frame to use.
        frames: number of frames to use, None for all.
        near: near plane in capture units; None for the capture's own, else 0.12 rig radii.
        every: step from one frame that is used to the next; the rate is divided by it.
        roving: whether a prepared capture's roving pictures are used, where it has some.

    Raises:
        CaptureError: the folder is missing, empty or of an unknown layout, or its content is broken.
        ConfigError: an argument is invalid.
    """
    folder, opens = _located(Path(path))
    if folder != Path(path).resolve():
        log.warning("%s is no capture, but holds one, which is opened: %s", path, folder)
    source = _opened(folder, opens)
    sized = selected(source, held_out=held_out, scale=scale, near=near)
    if opens is not open_prepared:
        return section(sized, start=start, frames=frames, every=every)
    capture = read_prepared(folder)
    if not sized.rig.held_out <= source.rig.held_out or (capture.roving and not roving):
        sized = WithoutPoints(sized)  # its points come from pictures that are not trained on now
    part = section(sized, start=start, frames=frames, every=every)
    return with_roving(part, sized, folder, capture) if roving else part


def selected(
    source: FrameSource,
    *,
    held_out: tuple[str, ...] | Literal["auto"] | None = None,
    scale: float = 1.0,
    near: float | None = None,
) -> FrameSource:
    """The capture with other cameras held out, reduced pictures, another near plane; see :func:`open_capture`."""
    rig = source.rig
    if held_out is not None:
        rig = rig.with_held_out(_chosen(held_out, rig))
    if near is not None:
        if not 0 < near < math.inf:
            raise ConfigError(f"The near plane must be positive, got {near:g}.")
        rig = with_near(rig, near)
    sized = resized(source, scale)
    if rig is not source.rig:
        sizes = {name: (sized.rig[name].width, sized.rig[name].height) for name in rig}
        rig = rig.mapped({name: rig[name].resized(*sizes[name]) for name in rig})
        sized = WithRig(sized, rig)
    return sized


def _chosen(held_out: tuple[str, ...] | Literal["auto"], rig: CameraRig) -> frozenset[str]:
    """The cameras of a choice; the command line's ``--held-out auto`` is a tuple, unless a camera has that name."""
    if held_out == AUTO or (held_out == (AUTO,) and AUTO not in rig.cameras):
        return frozenset({best_surrounded(rig)})
    if isinstance(held_out, str):
        raise ConfigError(f"held_out takes names of cameras, as ({held_out!r},), or 'auto'; got {held_out!r}.")
    return frozenset(held_out)


def _opener(path: Path) -> Callable[[Path], FrameSource] | None:
    """What opens the folder: that of the first layout that it has; None where it has none."""
    return next((opens for recognises, opens in CAPTURE_LAYOUTS if recognises(path)), None)


class Uncalibrated(CaptureError):
    """A folder without any file that could be a calibration: at best what cameras filmed, for ``prepare``."""


def _opened(folder: Path, opens: Callable[[Path], FrameSource]) -> FrameSource:
    try:
        source = opens(folder)
        try:
            check_rig(source.rig)
        except CalibrationError as error:
            raise CalibrationError(f"{folder}: {error}") from None
        return with_masks(source, masks_folder(folder))
    except NoFrames:
        if (above := _above(folder)) is None:
            raise
        raise CaptureError(
            f"{folder} holds the calibration of a capture alone; give the folder of the capture, {above}."
        ) from None


def layout_of(path: Path) -> str:
    """The layout of the capture that :func:`open_capture` opens, in words."""
    return _located(path)[1].__name__.removeprefix("open_").replace("_", " ")


def _located(path: Path) -> tuple[Path, Callable[[Path], FrameSource]]:
    """The folder of the capture that is in ``path``, which may be the same, and what opens it."""
    if not path.exists():
        raise CaptureError(f"The capture {path} does not exist; give the folder that holds it.")
    if not path.is_dir():
        raise CaptureError(f"The capture {path} is a file; give the folder that holds it.\n{LAYOUTS_HELP}")
    path = path.resolve()  # a name, even for "."
    if (opens := _opener(path)) is not None:
        return path, opens
    below = inner_folders(path)
    inner = [folder for folder in below if _opener(folder) is not None]
    inner = inner or [own for folder in below for own in inner_folders(folder) if _opener(own) is not None]
    if len(inner) == 1:
        return _located(inner[0])
    if inner:
        names = ", ".join(str(folder.relative_to(path)) for folder in inner[:4])
        raise CaptureError(f"{path} holds several captures ({names}); give the folder of one.")
    content = sorted(entry.name for entry in path.iterdir())
    if not content:
        raise CaptureError(f"The capture {path} is an empty folder.\n{LAYOUTS_HELP}")
    if (above := _above(path)) is not None:
        raise CaptureError(f"{path} has no calibration; the capture is the folder above it: give {above}.")
    shown = ", ".join(content[:6]) + (", ..." if len(content) > 6 else "")
    kind = Uncalibrated
    if any(Path(name).suffix.lower() in CALIBRATION_SUFFIXES for name in content):
        kind, why = CaptureError, f"no calibration that is known here; it holds {shown}{unread_files(path)}"
    elif has_frames(path):
        why = f"no calibration; it holds {shown}. structgstream prepare calibrates videos and pictures"
    else:
        why = f"no supported layout; it holds {shown}{unread_files(path)}"
    raise kind(f"The folder {path} has {why}.\n{LAYOUTS_HELP}")


def _above(path: Path) -> Path | None:
    """The capture of which ``path`` is a folder, up to three above; None where there is none."""
    for inside, folder in zip((path, *path.parents), path.parents[:3]):
        with suppress(OSError, StructGStreamError):
            if inside.name.lower() in PARTS and _opener(folder) is not None and has_frames(folder):
                return folder
    return None
