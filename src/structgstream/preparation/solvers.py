# SPDX-License-Identifier: Apache-2.0
"""Calls synchronisation and calibration with the pictures of the footage that they need."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from structgstream.data.calibration import listed
from structgstream.data.lenses import LensCamera
from structgstream.data.timeline import Clock
from structgstream.errors import CalibrationError, CaptureError
from structgstream.preparation.calibration.board_solving import solve_board
from structgstream.preparation.calibration.refinement import refine
from structgstream.preparation.calibration.solved import SolvedCalibration
from structgstream.preparation.calibration.structure import solve_structure
from structgstream.preparation.footage import Footage, find_footage
from structgstream.preparation.instants import (
    Picture,
    Shots,
    shared_seconds,
    shots_of,
    spread_moments,
    still_pictures,
)
from structgstream.preparation.options import PrepareOptions
from structgstream.preparation.synchronization import Method, synchronize

TIMESTAMPS = "timestamps.csv"
BOARD_SECONDS = 0.4
"""Between pictures of the board: it moves slowly, and neighbouring pictures say the same."""
BOARD_MOMENTS = 60
SURE_PERIODS = 0.5
"""Standard error of a clock, in frame periods, up to which pictures of one moment can be chosen by it."""


@dataclass(frozen=True)
class Clocks:
    """The clocks of all cameras.

    Args:
        clocks: by camera.
        method: how they were found, see ``preparation.synchronization``.
        told: that, and what else is to be known, in words.
        late_seconds: by camera, how much later than the common instants its frames are.
        uncertainty_seconds: by camera, standard error of its time.
        sure: whether pictures of one moment can be chosen by them.
    """

    clocks: Mapping[str, Clock]
    method: str
    told: str
    late_seconds: Mapping[str, float] = field(default_factory=dict)
    uncertainty_seconds: Mapping[str, float] = field(default_factory=dict)
    sure: bool = True


def synchronized(
    footage: Footage,
    options: PrepareOptions,
    *,
    cameras: Mapping[str, LensCamera] | None = None,
) -> Clocks:
    """The clocks of the cameras.

    Args:
        footage: what they filmed.
        options: ``synchronize`` says how.
        cameras: their calibration, where it is known.

    Raises:
        CaptureError: they cannot be synchronised so, or have no moment in common.
        ConfigError: an unknown method.
    """
    single = all(len(footage.stamps(name)) == 1 for name in footage.cameras)
    chosen: Method = "none" if single else options.synchronize
    table = footage.where / TIMESTAMPS
    try:
        found = synchronize(
            footage,
            method=chosen,
            timestamps=table if table.is_file() else None,
            cameras=cameras,
        )
    except CaptureError as error:
        if chosen != "auto":
            raise
        raise CaptureError(f"{error} Cameras that one signal starts need none of this: --synchronize none.") from None
    clocks = {name: estimate.clock for name, estimate in found.clocks.items()}
    shared_seconds(footage, clocks)
    told = " ".join([f"{found.method}: {found.reason}" + ("." if found.warnings else ""), *found.warnings])
    errors = {name: estimate.uncertainty_seconds for name, estimate in found.clocks.items()}
    return Clocks(
        clocks,
        found.method,
        told,
        {name: estimate.residual_seconds for name, estimate in found.clocks.items()},
        errors,
        found.method != "motion" or max(errors.values()) <= SURE_PERIODS / footage.fps,
    )


def first_clocks(footage: Footage, options: PrepareOptions) -> Clocks:
    """The clocks of cameras whose calibration is to be found without them: by motion they may be unsure, or unknown.

    Motion tells little without a calibration, and poses come from what stands still. So a failure is none here: with
    the calibration motion is looked at again.

    Raises:
        CaptureError: by another method they cannot be synchronised.
        ConfigError: an unknown method.
    """
    try:
        return synchronized(footage, options)
    except CaptureError as error:
        if options.synchronize not in ("auto", "motion") or (footage.where / TIMESTAMPS).is_file():
            raise
        told = f"motion: not without the calibration. {error}"
        return Clocks({name: Clock() for name in footage.cameras}, "motion", told, sure=False)


def solved_by(
    method: str,
    footage: Footage,
    clocks: Clocks,
    options: PrepareOptions,
    *,
    focals: Mapping[str, float] | None = None,
) -> SolvedCalibration:
    """Cameras by ``sfm`` or ``board``.

    Args:
        method: either.
        footage: what the cameras filmed.
        clocks: of the cameras.
        options: what is asked for.
        focals: focal lengths in pixels that cameras state, with which structure from motion begins.

    Raises:
        CalibrationError: the cameras see too little in common, or too little of the board.
        CaptureError: pictures cannot be read.
        MissingExtraError: pycolmap or cv2 is not installed.
    """
    if method == "sfm":
        pictures = matched_pictures(footage, clocks, options)
        return solve_structure(pictures, lens=options.lens or "radial", intrinsics=options.intrinsics, focals=focals)
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
    """The calibration adjusted to the pictures, and in words what that changed.

    Raises:
        CalibrationError: too few matches agree with the calibration.
        CaptureError: pictures cannot be read.
    """
    found = refine(
        matched_pictures(footage, clocks, options),
        solved.cameras,
        free="lens" if options.lens else "focal",
        lens=options.lens,
        metres=solved.metres,
    )
    told = (
        f"{found.held_back} matches that were kept out lie {found.before_pixels:.2f} px from their epipolar lines "
        f"before, {found.after_pixels:.2f} after"
    )
    return found.solved, told if found.changed else f"{told}: the given calibration stays"


def matched_pictures(
    footage: Footage, clocks: Clocks, options: PrepareOptions
) -> Mapping[str, Shots] | Mapping[str, list[Picture]]:
    """What structure from motion looks at: pictures of the same moments, or of what stands still while clocks are
    unsure.

    Raises:
        CaptureError: the cameras have no moment in common, or a picture cannot be read.
    """
    if not clocks.sure:
        return still_pictures(footage)
    first, last = shared_seconds(footage, clocks.clocks)
    return shots_of(footage, clocks.clocks, spread_moments(first, last, options.instants))


def board_footage(footage: Footage, options: PrepareOptions) -> Footage:
    """The videos in which the board is shown.

    Raises:
        CaptureError: a camera has none.
        CalibrationError: they have another size.
    """
    assert options.board_videos is not None, "asked before"
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
                f"Camera {name!r} filmed the board with {size[0]}x{size[1]} pixels ({found.path(name)}) and the take "
                f"with {other[0]}x{other[1]}; film both in one mode."
            )
    return found
