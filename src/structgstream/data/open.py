# SPDX-License-Identifier: Apache-2.0
"""Opens a capture from a folder of any supported layout, and chooses the camera to hold out where none is stated.

Note [Surrounded]
~~~~~~~~~~~~~~~~~
A held-out camera measures interpolation if others stand on all of its sides, and extrapolation at the rim of the rig.
The measure is the camera's Voronoi cell among the others, in the plane of its picture: the cell is bounded exactly if
the camera lies inside the convex hull of the others, and small if they stand near on all sides (Aurenhammer, ACM
Computing Surveys, 1991). With others at angles ``a`` and distances ``d``, the border of the cell in the direction ``u``
is at half of ``reach(u)``, the least ``d / cos(a - u)``. Three departures make it a measure of rigs:

- Of two opposite directions the farther reach counts for both, so that a twin on one side makes no camera surrounded.
- ``d`` is divided by the cosine of half the angle between both view directions: a camera that looks elsewhere surrounds
  nothing.
- A cell ends at the extent of the rig. In a row of cameras all cells are open upwards and downwards."""

import logging
import math
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Literal

import numpy as np

from structgstream.cameras import CameraRig
from structgstream.data import transforms
from structgstream.data.calibration import with_near
from structgstream.data.camera_files import ROOTS, has_frames, unread_files
from structgstream.data.colmap import find_model
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
from structgstream.data.found_calibrations import (
    calibration_below,
    has_calibration,
    inner_folders,
    read_calibration,
    recognizes_calibrated,
)
from structgstream.data.masks import FOLDER, with_masks
from structgstream.data.posed_capture import NoFrames, open_posed
from structgstream.data.prepared import open_prepared, recognizes_prepared
from structgstream.data.source import FrameSource, WithoutPoints, WithRig, resized, section
from structgstream.errors import CaptureError, ConfigError, StructGStreamError
from structgstream.geometry import Floats

log = logging.getLogger(__name__)

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


CAPTURE_LAYOUTS: tuple[tuple[Callable[[Path], bool], Callable[[Path], FrameSource]], ...] = (
    (recognizes_prepared, open_prepared),
    (lambda path: (path / TRAIN).is_file(), open_panoptic),
    (lambda path: (path / CAMERAS_FILE).is_file(), open_json_videos),
    (lambda path: (path / POSES).is_file(), open_n3dv),
    (lambda path: (path / MODELS_FILE).is_file(), open_immersive),
    (lambda path: find_model(path) is not None, open_calibrated),
    (lambda path: bool(transforms.find(path)), transforms.open_transforms),
    (recognizes_calibrated, open_calibrated),
    (lambda path: calibration_below(path) is not None, open_calibrated),
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
) -> FrameSource:
    """Opens the capture in a folder, recognising its layout.

    Args:
        path: the folder.
        held_out: names of the cameras to keep from training; None for those that the layout holds out; "auto" for the
            one best surrounded by others (:func:`~structgstream.data.open.best_surrounded`).
        scale: size of the pictures relative to the stored ones, in (0, 1].
        start: first frame to use.
        frames: number of frames to use, None for all.
        near: near plane in capture units; None for the capture's own, else 0.12 rig radii.
        every: step from one frame that is used to the next; the rate is divided by it.

    Raises:
        CaptureError: the folder is missing, empty or of an unknown layout, or its content is broken.
        ConfigError: an argument is invalid.
    """
    folder, opens = _located(Path(path))
    if folder != Path(path).resolve():
        log.warning("%s is no capture, but holds one, which is opened: %s", path, folder)
    source = _opened(folder, opens)
    sized = selected(source, held_out=held_out, scale=scale, near=near)
    if opens is open_prepared and not sized.rig.held_out <= source.rig.held_out:
        sized = WithoutPoints(sized)  # its points come from pictures of a camera that is held out now
    return section(sized, start=start, frames=frames, every=every)


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
        return with_masks(opens(folder), folder / FOLDER)
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
    if any(Path(name).suffix.lower() in CALIBRATION_SUFFIXES for name in content):
        kind, why = CaptureError, f"no calibration that is known here; it holds {shown}{unread_files(path)}"
    elif has_frames(path):
        kind, why = (
            Uncalibrated,
            f"no calibration; it holds {shown}. structgstream prepare calibrates videos and pictures",
        )
    else:
        kind, why = Uncalibrated, f"no supported layout; it holds {shown}{unread_files(path)}"
    raise kind(f"The folder {path} has {why}.\n{LAYOUTS_HELP}")


def _above(path: Path) -> Path | None:
    """The capture of which ``path`` is a folder, up to three above; None where there is none."""
    for inside, folder in zip((path, *path.parents), path.parents[:3]):
        with suppress(OSError, StructGStreamError):
            if inside.name.lower() in PARTS and _opener(folder) is not None and has_frames(folder):
                return folder
    return None


DIRECTIONS = 360
ALIKE = 1.5
"""Cells whose areas differ by less are alike, as cameras are placed by hand; the most central of them is taken."""


def best_surrounded(rig: CameraRig) -> str:
    """The camera with the smallest cell among the others; see Note [Surrounded].

    Among cells of half as much again, the one with the least mean distance to the others, then the first of the rig.
    The rig's own held-out set plays no part.

    Raises:
        ConfigError: fewer than three cameras, of which none can be spared.
    """
    names = list(rig)
    if len(names) < 3:
        raise ConfigError(
            f"A camera can be held out of three or more, and the rig has {len(names)} ({', '.join(names)}); "
            "film with another camera, or hold out none."
        )
    centers = rig.centers.numpy()
    extent = float(np.linalg.norm(centers[:, None] - centers, axis=-1).max())
    if extent == 0:
        return names[0]
    cells = np.array([_cell(*_others(rig, name), most=extent) for name in names])
    away = np.linalg.norm(centers[:, None] - centers, axis=-1).mean(1) / extent
    alike = np.flatnonzero(cells <= ALIKE * cells.min())
    # Rounded, so that equal cameras do not differ by the machine's last bit.
    return names[min(alike, key=lambda index: (round(float(away[index]), 6), index))]


def _others(rig: CameraRig, name: str) -> tuple[Floats, Floats]:
    """Where the others stand in the plane of a camera's picture: angles in radians and distances, each ``[N]``.

    Cameras that look the other way, or stand on its optical axis, are left out.
    """
    own = rig[name].viewmat.numpy()
    angles, distances = [], []
    for other in rig:
        if other == name:
            continue
        toward = own[:3, :3] @ (rig[other].center.numpy() - rig[name].center.numpy())
        distance = float(np.linalg.norm(toward))
        along = float(own[2, :3] @ rig[other].viewmat.numpy()[2, :3])  # cosine between the view directions
        turned = np.sqrt(max((1 + along) / 2, 0.0))  # of half the angle
        across = float(np.linalg.norm(toward[:2]))
        if turned > 1e-3 and across > 1e-6 * distance:
            angles.append(np.arctan2(toward[1], toward[0]))
            distances.append(distance / turned)
    return np.array(angles), np.array(distances)


def _cell(angles: Floats, distances: Floats, *, most: float) -> float:
    """The area of the symmetric cell that ends at ``most``, in circles of that radius."""
    if not len(angles):
        return 1.0
    directions = np.linspace(0, 2 * np.pi, DIRECTIONS, endpoint=False)
    cosines = np.maximum(np.cos(directions[:, None] - angles), 1e-9)
    reach = np.minimum((distances / cosines).min(1) / most, 1.0)
    return float((np.maximum(reach, np.roll(reach, DIRECTIONS // 2)) ** 2).mean())
