# SPDX-License-Identifier: Apache-2.0
"""Clocks and cameras by the method that is chosen: solved from the pictures that it needs, or given by a file.

What the pictures do not allow is a ``CalibrationError``, what cannot be read or synchronised a ``CaptureError``.
"""

import os
import shlex
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from structgstream.data.calibration import Calibration, PosedCamera, listed
from structgstream.data.dataset_layouts import CAMERAS_FILE, MODELS_FILE, read_cameras, read_models
from structgstream.data.images import read_exif
from structgstream.data.lenses import LensCamera, Pinhole
from structgstream.data.open import calibration_below, read_calibration
from structgstream.data.posed_capture import filmed_by, orientations
from structgstream.data.prepared import FILE as PREPARED
from structgstream.data.prepared import LENSES, camera_of, filmed_entry, read_prepared
from structgstream.data.timeline import Clock
from structgstream.errors import CalibrationError, CaptureError
from structgstream.preparation.calibration.board_solving import solve_board
from structgstream.preparation.calibration.solved import Observations, RovingFrames, SolvedCalibration
from structgstream.preparation.calibration.structure import refine, solve_structure
from structgstream.preparation.footage import (
    Footage,
    Picture,
    Shots,
    find_footage,
    shared_seconds,
    sharpest_frames,
    shots_of,
    spread_moments,
    still_pictures,
)
from structgstream.preparation.options import PrepareOptions
from structgstream.preparation.output_folder import Packing, Stored
from structgstream.preparation.synchronization.synchronize import Method, synchronize

TIMESTAMPS = "timestamps.csv"
SURE_PERIODS = 0.5
"""Standard error of a clock, in frame periods, up to which pictures of one moment can be chosen by it."""


@dataclass(frozen=True)
class Clocks:
    """The clocks of all cameras."""

    clocks: Mapping[str, Clock]  # by camera
    method: str  # how they were found, see ``preparation.synchronization``
    summary: str  # the method and its warnings, for users
    sure: bool = True  # whether pictures of one moment can be chosen by them


def synchronized(
    footage: Footage, options: PrepareOptions, *, cameras: Mapping[str, LensCamera] | None = None
) -> Clocks:
    """The clocks of the cameras by the method of the options, with their calibration where it is known.

    Raises:
        CaptureError: they cannot be synchronised so, or have no moment in common.
    """
    single = all(len(footage.stamps(name)) == 1 for name in footage.cameras)
    chosen: Method = "none" if single else options.synchronize
    try:
        found = synchronize(footage, method=chosen, timestamps=find_timestamps(footage), cameras=cameras)
    except CaptureError as error:
        if chosen != "auto":
            raise
        raise CaptureError(f"{error} Cameras that one signal starts need none of this: --synchronize none.") from None
    summary = " ".join([f"{found.method}: {found.reason}" + ("." if found.warnings else ""), *found.warnings])
    sure = found.method != "motion" or max(found.uncertainty_seconds.values()) <= SURE_PERIODS / footage.fps
    return Clocks(found.clocks, found.method, summary, sure)


def find_timestamps(footage: Footage) -> Path | None:
    """The table of times: beside the videos, which may lie below the folder that was given, or in that one."""
    beside = Path(os.path.commonpath(footage.files.values()))
    return next((table for folder in (beside, footage.where) if (table := folder / TIMESTAMPS).is_file()), None)


def first_clocks(footage: Footage, options: PrepareOptions) -> Clocks:
    """The clocks of cameras whose calibration is to be found without them: by motion they may be unsure, or unknown.

    Motion is inexact without a calibration, and poses come from what stands still. So a failure by motion is no error
    here: motion is compared again once the calibration is known.
    """
    try:
        return synchronized(footage, options)
    except CaptureError as error:
        if options.synchronize not in ("auto", "motion") or find_timestamps(footage) is not None:
            raise
        summary = f"motion: not without the calibration. {error}"
        return Clocks({name: Clock() for name in footage.cameras}, "motion", summary, sure=False)


def _unpacked_clocks(stored: Stored) -> Clocks:
    clocks = {name: Clock(**clock) for name, clock in stored.values["clocks"].items()}
    return Clocks(**{**stored.values, "clocks": clocks})


CLOCKS = Packing(lambda found: Stored(asdict(found)), _unpacked_clocks)


BOARD_SECONDS = 0.4
"""Between pictures of the board: it moves slowly, and neighbouring pictures show the same."""
BOARD_MOMENTS = 60


def solve_cameras(
    method: str,
    footage: Footage,
    clocks: Clocks,
    options: PrepareOptions,
    *,
    focals: Mapping[str, float],
    roving: Footage | None = None,
) -> SolvedCalibration:
    """Cameras by ``sfm``, which begins with ``focals``, the focal lengths in pixels that cameras state, and registers
    frames of ``roving``, or by ``board``."""
    if method == "sfm":
        return solve_structure(
            matched_pictures(footage, clocks, options),
            lens=options.lens or "radial",
            intrinsics=options.intrinsics,
            focals=focals,
            roving=None if roving is None else sharpest_frames(roving),
        )
    if options.board_videos is not None:
        footage = board_footage(footage, options)
        clocks = synchronized(footage, options)
    first, last = shared_seconds(footage, clocks.clocks)
    count = min(BOARD_MOMENTS, 1 + int((last - first) / BOARD_SECONDS))
    shots = shots_of(footage, clocks.clocks, spread_moments(first, last, max(count, 2)))
    return solve_board(shots, options.board, lens=options.lens or "opencv")


def refined(
    solved: SolvedCalibration, footage: Footage, clocks: Clocks, options: PrepareOptions
) -> tuple[SolvedCalibration, str]:
    """The calibration adjusted to the pictures, and a sentence on what that changed."""
    pictures = matched_pictures(footage, clocks, options)
    found = refine(pictures, solved.cameras, lens=options.lens, metres=solved.metres)
    summary = (
        f"{found.held_out} held-out matches lie {found.before_pixels:.2f} px from their epipolar lines before, "
        f"{found.after_pixels:.2f} after"
    )
    return found.solved, summary if found.changed else f"{summary}: the given calibration stays"


def matched_pictures(
    footage: Footage, clocks: Clocks, options: PrepareOptions
) -> Mapping[str, Shots] | Mapping[str, list[Picture]]:
    """What structure from motion looks at: pictures of the same moments, or of what stands still while clocks are
    unsure."""
    if not clocks.sure:
        return still_pictures(footage)
    first, last = shared_seconds(footage, clocks.clocks)
    return shots_of(footage, clocks.clocks, spread_moments(first, last, options.instants))


def board_footage(footage: Footage, options: PrepareOptions) -> Footage:
    """The videos in which the board is shown."""
    assert options.board_videos is not None, "checked before"
    found = find_footage(options.board_videos, picture_fps=options.fps)
    if missing := [name for name in footage.cameras if name not in found.cameras]:
        raise CaptureError(
            f"{options.board_videos} has no video of {listed(missing)} of {footage.where}; film the board with it too, "
            "under the same name, or leave it out with --without."
        )
    found = found.only(footage.cameras)
    for name in footage.cameras:
        size, other = found.size(name), footage.size(name)
        if size != other:
            raise CalibrationError(
                f"Camera {name!r} filmed the board with {size[0]}x{size[1]} pixels ({found.files[name]}) and the take "
                f"with {other[0]}x{other[1]}; film both in one mode."
            )
    return found


def check_complete(solved: SolvedCalibration, footage: Footage) -> SolvedCalibration:
    """The calibration itself; a ``CalibrationError`` where cameras could not be placed."""
    if missing := [name for name in footage.cameras if name not in solved.cameras]:
        raise CalibrationError(
            f"{listed(missing)} of {footage.where} could not be placed among the other {len(solved.cameras)}: their "
            "pictures have too little in common; move them closer to the others or show a board to all (structgstream "
            f"board), or go on without: --without {shlex.join(missing)}."
        )
    return solved


def stated_focals(footage: Footage) -> dict[str, float]:
    """Focal lengths in pixels of those cameras whose first picture states one (Exif); videos do not."""
    stated = {name: read_exif(files[0]).focal_pixels for name, files in footage.stills.items()}
    return {name: focal for name, focal in stated.items() if focal is not None}


def describe_focals(focals: Mapping[str, float], footage: Footage) -> str:
    """Which focal lengths calibration begins with, for users; empty for none."""
    if not focals:
        return ""
    shares = sorted(focal / max(footage.size(name)) for name, focal in focals.items())
    span = f"{shares[0]:.3f}" + (f" to {shares[-1]:.3f}" if shares[-1] - shares[0] > 5e-4 else "")
    return (
        f"began with the focal lengths that the pictures of {len(focals)} of {len(footage.cameras)} cameras state "
        f"({span} of the longer side)"
    )


def describe_turns(footage: Footage) -> str:
    """Which cameras' pictures are to be turned to be seen upright (Exif), for users; empty for none.

    A prepared capture has pixels as they are stored, so pictures are never turned, only reported.
    """
    turned = [name for name, files in footage.stills.items() if read_exif(files[0]).orientation != 1]
    if not turned:
        return ""
    return (
        f"the files of {listed(turned)} say that pictures are to be turned (Exif orientation), and they are taken as "
        "they are stored: turn them without loss (exiftran -a, jpegtran) to have them upright"
    )


def summary(solved: SolvedCalibration) -> str:
    """A calibration in one line."""
    text = f"{len(solved.cameras)} cameras"
    if len(solved.observations):
        errors = solved.errors()
        errors = errors[np.isfinite(errors)]
        text += f", {len(solved.points)} points, median reprojection error {np.median(errors):.2f} px"
    return text if solved.roving is None else f"{text}; {solved.roving.summary}"


def packed(solved: SolvedCalibration) -> Stored:
    """The calibration as plain values."""
    cameras = {name: filmed_entry(filmed) for name, filmed in solved.cameras.items()}
    arrays = {"points": solved.points, **vars(solved.observations)}
    values = {"cameras": cameras, "missing": list(solved.missing), "metres": solved.metres}
    if (roving := solved.roving) is not None:
        frames = {name: filmed_entry(filmed) for name, filmed in roving.cameras.items()}
        values["roving"] = {**vars(roving), "cameras": frames}
    return Stored(values, arrays)


def unpacked(stored: Stored) -> SolvedCalibration:
    """The reverse of :func:`packed`."""
    seen = {name: array for name, array in stored.arrays.items() if name != "points"}
    missing, metres = tuple(stored.values["missing"]), bool(stored.values["metres"])
    roving = None
    if (found := stored.values.get("roving")) is not None:
        roving = RovingFrames(**{**found, "cameras": _cameras(found["cameras"]), "bridged": tuple(found["bridged"])})
    cameras = _cameras(stored.values["cameras"])
    return SolvedCalibration(cameras, stored.arrays["points"], Observations(**seen), missing, metres, roving)


CALIBRATION = Packing(packed, unpacked)
REFINED = Packing[tuple[SolvedCalibration, str]](
    lambda found: Stored({**packed(found[0]).values, "detail": found[1]}, packed(found[0]).arrays),
    lambda stored: (unpacked(stored), str(stored.values["detail"])),
)


def _cameras(entries: Mapping[str, Any]) -> dict[str, LensCamera]:
    cameras = {}
    for name, entry in entries.items():
        lens = dict(entry["lens"])
        kind = LENSES[lens.pop("model")]
        cameras[name] = LensCamera(camera_of(entry["viewmat"], entry["K"], entry["size"]), kind(**lens))
    return cameras


def find_calibration(where: Path) -> Calibration | None:
    """The calibration in a folder or one folder below, or that a file holds; None when there is none that is known."""
    folder, file = (where, None) if where.is_dir() else (where.parent, where)
    for name, read in ((PREPARED, _of_prepared), (CAMERAS_FILE, _of_cameras), (MODELS_FILE, read_models)):
        if (folder / name).is_file() and file in (None, folder / name):
            return read(folder / name)
    if (found := read_calibration(folder, file)) is not None or file is not None:
        return found
    below = calibration_below(folder)
    return None if below is None else read_calibration(below)


def require_calibration(where: Path) -> Calibration:
    """As :func:`find_calibration`; a ``CalibrationError`` where there is none."""
    if not where.exists():
        raise CalibrationError(f"The calibration {where} does not exist; give a file or a folder of docs/captures.md.")
    found = find_calibration(where)
    if found is None:
        raise CalibrationError(
            f"{where} is no calibration that is known; expected a file of docs/captures.md (aniposelib, EasyMocap, "
            "multical, Kalibr, CMU Panoptic, Qualisys, ZJU-MoCap, OpenCV, transforms.json, models.json, COLMAP)."
        )
    return found


def _of_prepared(file: Path) -> Calibration:
    capture = read_prepared(file.parent)
    cameras = tuple(_posed(name, camera.filmed) for name, camera in capture.cameras.items())
    return Calibration(file, cameras, held_out=sorted(capture.held_out), turned_by_exif=False)


def _of_cameras(file: Path) -> Calibration:
    rig, _, _ = read_cameras(file)
    cameras = tuple(_posed(name, LensCamera(camera, Pinhole())) for name, camera in rig.cameras.items())
    return Calibration(file, cameras, held_out=rig.testing)


def _posed(name: str, filmed: LensCamera) -> PosedCamera:
    own = filmed.camera
    return PosedCamera(name, own.viewmat.numpy(), own.K.numpy(), (own.width, own.height), filmed.lens)


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
