# SPDX-License-Identifier: Apache-2.0
"""A calibration that is there already: of another tool, of another capture, or a file of cameras."""

from pathlib import Path

import numpy as np

from structgstream.data.calibration import Calibration, PosedCamera, listed
from structgstream.data.dataset_layouts import MODELS_FILE, read_models
from structgstream.data.found_calibrations import calibration_below, read_calibration
from structgstream.data.json_videos import FILE as CAMERAS
from structgstream.data.json_videos import read_cameras
from structgstream.data.lenses import Pinhole
from structgstream.data.posed_capture import filmed_by, orientations
from structgstream.data.prepared import FILE as PREPARED
from structgstream.data.prepared import read_prepared
from structgstream.errors import CalibrationError
from structgstream.preparation.calibration.solved import Observations, SolvedCalibration
from structgstream.preparation.footage import Footage


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
    if meant(MODELS_FILE):
        return read_models(folder / MODELS_FILE)
    if (found := read_calibration(folder, file)) is not None or file is not None:
        return found
    below = calibration_below(folder)
    return None if below is None else read_calibration(below)


def require_calibration(where: Path) -> Calibration:
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


def given_cameras(calibration: Calibration, footage: Footage) -> SolvedCalibration:
    """The cameras of a given calibration, for these pictures.

    Raises:
        CalibrationError: it belongs to other cameras, to pictures of another size, or to pictures turned by their EXIF
            orientation, while a prepared capture has them as they are stored.
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


def calibration_key(calibration: Calibration) -> list[object]:
    """Every value of a calibration that results depend on, as JSON can hold it; its files may be several."""
    cameras = [
        (camera.name, camera.viewmat.tolist(), camera.K.tolist(), camera.size, repr(camera.lens))
        for camera in calibration.cameras
    ]
    return [str(calibration.where), cameras, None if calibration.points is None else calibration.points.tolist()]
