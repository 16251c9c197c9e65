# SPDX-License-Identifier: Apache-2.0
"""The step that finds the cameras: structure from motion, a board, or a calibration that is there already."""

import shlex
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from structgstream.data.calibration import listed
from structgstream.data.exif import read_exif
from structgstream.data.found_calibrations import calibration_below, read_calibration
from structgstream.data.immersive import MODELS, read_models
from structgstream.data.json_videos import FILE as CAMERAS
from structgstream.data.json_videos import read_cameras
from structgstream.data.lenses import LensCamera, Pinhole
from structgstream.data.posed import Calibration, PosedCamera
from structgstream.data.posed_capture import filmed_by, orientations
from structgstream.data.prepared import FILE as PREPARED
from structgstream.data.prepared import LENSES, camera_of, lens_model, read_prepared
from structgstream.errors import CalibrationError, ConfigError
from structgstream.preparation.calibration.solved import Observations, SolvedCalibration, with_distance
from structgstream.preparation.footage import Footage
from structgstream.preparation.options import METHODS, PrepareOptions
from structgstream.preparation.steps import Stored

MIN_CAMERAS = 3


def chosen_method(footage: Footage, options: PrepareOptions) -> str | Calibration:
    """``sfm``, ``board``, or the calibration to use.

    Raises:
        CalibrationError: the calibration that was asked for is missing or broken.
    """
    if str(options.calibration) not in METHODS:
        return demand_calibration(Path(options.calibration))
    if options.calibration != "auto":
        return str(options.calibration)
    if options.board_videos is not None:
        return "board"
    return find_calibration(footage.where) or "sfm"


def check_used(method: str | Calibration, footage: Footage, options: PrepareOptions) -> None:
    """
    Raises:
        ConfigError: something is asked for that has no effect, so that its user expects another capture.
    """
    if options.fps is not None and footage.tracks:
        raise ConfigError(
            f"The videos of {footage.where} state the time of each frame, and --fps is the rate of folders of "
            "pictures; leave out --fps."
        )
    if options.board_videos is not None and method != "board":
        raise ConfigError(
            "Videos of a board (--board-videos) calibrate by --calibration board alone; choose that, or leave them out."
        )
    if options.intrinsics != "own" and method != "sfm":
        raise ConfigError(
            "Shared intrinsics (--intrinsics) are estimated by structure from motion alone; choose --calibration sfm, "
            "or leave them out."
        )
    if options.lens is not None and isinstance(method, Calibration) and not options.refine:
        raise ConfigError(
            f"{method.where} states the lenses, so --lens {options.lens} has no effect; add --refine to adjust them to "
            "the pictures, choose --calibration sfm, or leave out --lens."
        )


def check_board(method: str | Calibration, options: PrepareOptions) -> None:
    """
    Raises:
        ConfigError: a board whose markers OpenCV does not have.
        MissingExtraError: cv2 is not installed.
    """
    if method == "board":
        options.board.opencv_board()


def check_enough(footage: Footage) -> None:
    """
    Raises:
        CalibrationError: too few cameras for poses that can be checked.
    """
    if len(footage.cameras) < MIN_CAMERAS:
        raise CalibrationError(
            f"{footage.where} has {listed(footage.cameras)} alone; a capture needs {MIN_CAMERAS} or more, as two "
            "cameras cannot confirm each other's calibration: film with more."
        )


def from_other_tool(calibration: Calibration, footage: Footage) -> SolvedCalibration:
    """The cameras of a calibration that is there, for these pictures.

    Raises:
        CalibrationError: it is of other cameras, of pictures of another size, or of pictures that are turned as their
            EXIF orientation says, while a prepared capture has them as they are stored.
    """
    turns = orientations(calibration, {name: files[0] for name, files in footage.stills.items()})
    if turned := [name for name, turn in turns.items() if turn != 1]:
        raise CalibrationError(
            f"{calibration.where} is for pictures that are turned as their EXIF orientation says, and those of "
            f"{listed(turned)} are stored otherwise; turn them without loss (exiftran -a, jpegtran), so that they are "
            "stored upright, or give the folder with the calibration to reconstruct as it is."
        )
    sizes = {name: footage.size(name) for name in footage.cameras}
    filmed = filmed_by(calibration, sizes, root=footage.where)
    points = np.empty((0, 3)) if calibration.points is None else calibration.points
    none = np.empty(0, np.intp)
    return SolvedCalibration(filmed, points, Observations(none, none, np.empty((0, 2)), none))


def described(calibration: Calibration) -> list[object]:
    """All that a result depends on of a calibration, whose files may be several: as JSON can hold it."""
    cameras = [
        (camera.name, camera.viewmat.tolist(), camera.K.tolist(), camera.size, repr(camera.lens))
        for camera in calibration.cameras
    ]
    return [str(calibration.where), cameras, None if calibration.points is None else calibration.points.tolist()]


def check_complete(solved: SolvedCalibration, footage: Footage) -> SolvedCalibration:
    """The calibration itself.

    Raises:
        CalibrationError: cameras could not be placed.
    """
    missing = [name for name in footage.cameras if name not in solved.cameras]
    if missing:
        raise CalibrationError(
            f"{listed(missing)} of {footage.where} could not be placed among the other {len(solved.cameras)}: their "
            "pictures have too little in common; move them closer to the others or show a board to all (structgstream "
            f"board), or go on without: --without {shlex.join(missing)}."
        )
    return solved


def packed(solved: SolvedCalibration) -> Stored:
    """The calibration as plain values."""
    cameras: dict[str, Any] = {}
    for name, filmed in solved.cameras.items():
        camera = filmed.camera
        cameras[name] = {
            "size": [camera.width, camera.height],
            "K": camera.K.tolist(),
            "viewmat": camera.viewmat.tolist(),
            "lens": {"model": lens_model(filmed.lens), **asdict(filmed.lens)},
        }
    seen = solved.observations
    arrays = {
        "points": solved.points, "point": seen.point, "camera": seen.camera, "pixels": seen.pixels,
        "instant": seen.instant,
    }  # fmt: skip
    return Stored({"cameras": cameras, "missing": list(solved.missing), "metres": solved.metres}, arrays)


def unpacked(stored: Stored) -> SolvedCalibration:
    """The reverse of :func:`packed`."""
    cameras = {}
    for name, entry in stored.values["cameras"].items():
        lens = dict(entry["lens"])
        kind = LENSES[lens.pop("model")]
        cameras[name] = LensCamera(camera_of(entry["viewmat"], entry["K"], entry["size"]), kind(**lens))
    arrays = stored.arrays
    seen = Observations(arrays["point"], arrays["camera"], arrays["pixels"], arrays["instant"])
    missing = tuple(stored.values["missing"])
    return SolvedCalibration(cameras, arrays["points"], seen, missing, bool(stored.values["metres"]))


def summary(solved: SolvedCalibration) -> str:
    """A calibration in one line."""
    told = f"{len(solved.cameras)} cameras"
    if len(solved.observations):
        errors = solved.errors()
        errors = errors[np.isfinite(errors)]
        told += f", {len(solved.points)} points, median reprojection error {np.median(errors):.2f} px"
    return told


def scaled(solved: SolvedCalibration, options: PrepareOptions) -> SolvedCalibration:
    """The calibration in metres when a distance was measured.

    Raises:
        CalibrationError: the distance is of cameras that are not there, or that stand in one place.
    """
    distance = options.distance
    if distance is None:
        return solved
    return with_distance(solved, distance.first, distance.second, metres=distance.metres)


def find_calibration(where: Path) -> Calibration | None:
    """The calibration in a folder or one folder below, or that a file holds; None when there is none that is known.

    Raises:
        CalibrationError: it is broken, or a pickle.
    """
    folder, file = (where, None) if where.is_dir() else (where.parent, where)

    def meant(name: str) -> bool:
        return (folder / name).is_file() and file in (None, folder / name)

    if meant(PREPARED):
        return _of_prepared(folder)
    if meant(CAMERAS):
        return _of_cameras(folder / CAMERAS)
    if meant(MODELS):
        return read_models(folder / MODELS)
    if (found := read_calibration(folder, file)) is not None or file is not None:
        return found
    below = calibration_below(folder)
    return None if below is None else read_calibration(below)


def demand_calibration(where: Path) -> Calibration:
    """As :func:`find_calibration`.

    Raises:
        CalibrationError: there is none, or it is broken.
    """
    if not where.exists():
        raise CalibrationError(f"The calibration {where} does not exist; give a file or a folder of docs/captures.md.")
    found = find_calibration(where)
    if found is None:
        raise CalibrationError(
            f"{where} is no calibration that is known; expected a file of docs/captures.md (aniposelib, EasyMocap, "
            "multical, Kalibr, CMU Panoptic, Qualisys, ZJU-MoCap, OpenCV, transforms.json, models.json, COLMAP)."
        )
    return found


def _of_prepared(folder: Path) -> Calibration:
    capture = read_prepared(folder)
    cameras = []
    for name, camera in capture.cameras.items():
        filmed = camera.filmed.camera
        size = (filmed.width, filmed.height)
        cameras.append(PosedCamera(name, filmed.viewmat.numpy(), filmed.K.numpy(), size, camera.filmed.lens))
    return Calibration(folder / PREPARED, tuple(cameras), held_out=sorted(capture.held_out), turned_by_exif=False)


def _of_cameras(file: Path) -> Calibration:
    rig, _, _ = read_cameras(file)
    cameras = tuple(
        PosedCamera(name, camera.viewmat.numpy(), camera.K.numpy(), (camera.width, camera.height), Pinhole())
        for name, camera in rig.cameras.items()
    )
    return Calibration(file, cameras, held_out=rig.testing)


def stated_focals(footage: Footage) -> dict[str, float]:
    """Focal lengths in pixels of those cameras whose first picture states one (Exif); videos do not.

    Raises:
        CaptureError: a picture cannot be read.
        MissingExtraError: Pillow is not installed.
    """
    stated = {name: read_exif(files[0]).focal_pixels for name, files in footage.stills.items()}
    return {name: focal for name, focal in stated.items() if focal is not None}


def focals_told(focals: Mapping[str, float], footage: Footage) -> str:
    """What was stated, in words; empty for nothing."""
    if not focals:
        return ""
    shares = sorted(focal / max(footage.size(name)) for name, focal in focals.items())
    span = f"{shares[0]:.3f}" + (f" to {shares[-1]:.3f}" if shares[-1] - shares[0] > 5e-4 else "")
    return (
        f"began with the focal lengths that the pictures of {len(focals)} of {len(footage.cameras)} cameras state "
        f"({span} of the longer side)"
    )


def turns_told(footage: Footage) -> str:
    """Which cameras' pictures are to be turned to be seen upright (Exif), in words; empty for none.

    A prepared capture has pixels as they are stored, so pictures are never turned: that is said, not done.

    Raises:
        CaptureError: a picture cannot be read.
        MissingExtraError: Pillow is not installed.
    """
    turned = [name for name, files in footage.stills.items() if read_exif(files[0]).orientation != 1]
    if not turned:
        return ""
    return (
        f"the files of {listed(turned)} say that pictures are to be turned (Exif orientation), and they are taken as "
        "they are stored: turn them without loss (exiftran -a, jpegtran) to have them upright"
    )
