# SPDX-License-Identifier: Apache-2.0
"""Calls synchronisation, calibration and tone curves with the pictures of the footage that they need."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from structgstream.data.calibration import listed
from structgstream.data.lenses import LensCamera
from structgstream.data.timeline import Clock
from structgstream.data.tone import ToneCurve
from structgstream.errors import CalibrationError, CaptureError
from structgstream.preparation.calibration.board_solving import solve_board
from structgstream.preparation.calibration.refinement import refine
from structgstream.preparation.calibration.solved import SolvedCalibration
from structgstream.preparation.calibration.structure import solve_structure
from structgstream.preparation.footage import Footage, find_footage
from structgstream.preparation.instants import Shots, shared_seconds, shots_of, spread_moments
from structgstream.preparation.options import PrepareOptions
from structgstream.preparation.synchronization import Method, synchronize
from structgstream.preparation.tone import estimate_tones, sample_colors

TIMESTAMPS = "timestamps.csv"
BOARD_SECONDS = 0.4
"""Between pictures of the board: it moves slowly, and neighbouring pictures say the same."""
BOARD_MOMENTS = 60


@dataclass(frozen=True)
class Clocks:
    """The clocks of all cameras.

    Args:
        clocks: by camera.
        method: how they were found, see ``preparation.synchronization``.
        told: that, and what else is to be known, in words.
        late_seconds: by camera, how much later than the common instants its frames are.
        uncertainty_seconds: by camera, standard error of its time.
    """

    clocks: Mapping[str, Clock]
    method: str
    told: str
    late_seconds: Mapping[str, float] = field(default_factory=dict)
    uncertainty_seconds: Mapping[str, float] = field(default_factory=dict)


def synchronized(
    footage: Footage,
    options: PrepareOptions,
    *,
    cameras: Mapping[str, LensCamera] | None = None,
    method: Method | None = None,
) -> Clocks:
    """The clocks of the cameras.

    Args:
        footage: what they filmed.
        options: ``synchronize`` says how.
        cameras: their calibration, where it is known.
        method: in place of that of the options.

    Raises:
        CaptureError: they cannot be synchronised so, or have no moment in common.
        ConfigError: an unknown method.
    """
    single = all(len(footage.stamps(name)) == 1 for name in footage.cameras)
    chosen: Method = "none" if single else method or options.synchronize
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
    told = f"{found.method}: {found.reason}" + "".join(f" {warning}" for warning in found.warnings)
    return Clocks(
        clocks,
        found.method,
        told,
        {name: estimate.residual_seconds for name, estimate in found.clocks.items()},
        {name: estimate.uncertainty_seconds for name, estimate in found.clocks.items()},
    )


def solved_by(method: str, footage: Footage, clocks: Mapping[str, Clock], options: PrepareOptions) -> SolvedCalibration:
    """Cameras by ``sfm`` or ``board``.

    Raises:
        CalibrationError: the cameras see too little in common, or too little of the board.
        CaptureError: pictures cannot be read.
        MissingExtraError: pycolmap or cv2 is not installed.
    """
    if method == "sfm":
        shots = moments_of(footage, clocks, options)
        return solve_structure(shots, lens=options.lens or "radial", intrinsics=options.intrinsics)
    if options.board_videos is not None:
        footage = board_footage(footage, options)
        clocks = synchronized(footage, options).clocks
    first, last = shared_seconds(footage, clocks)
    count = min(BOARD_MOMENTS, 1 + int((last - first) / BOARD_SECONDS))
    shots = shots_of(footage, clocks, spread_moments(first, last, max(count, 2)))
    return solve_board(shots, options.board, lens=options.lens or "opencv")


def refined(
    solved: SolvedCalibration, footage: Footage, clocks: Mapping[str, Clock], options: PrepareOptions
) -> tuple[SolvedCalibration, str]:
    """The calibration adjusted to the pictures, and in words what that changed.

    Raises:
        CalibrationError: too few matches agree with the calibration.
        CaptureError: pictures cannot be read.
    """
    shots = moments_of(footage, clocks, options)
    found = refine(
        shots, solved.cameras, free="lens" if options.lens else "focal", lens=options.lens, metres=solved.metres
    )
    told = (
        f"{found.held_back} matches that were kept out lie {found.before_pixels:.2f} px from their epipolar lines "
        f"before, {found.after_pixels:.2f} after"
    )
    return found.solved, told if found.changed else f"{told}: the given calibration stays"


def tone_curves(
    solved: SolvedCalibration, shots: Mapping[str, Shots], *, held_out: Sequence[str]
) -> tuple[dict[str, ToneCurve], str]:
    """A tone curve for each camera, and in words what they change.

    Raises:
        CaptureError: too few points have colours.
    """
    if not len(solved.observations):
        raise CaptureError(
            "Tone curves need the points of structure from motion or --refine, and this calibration has none; "
            "add --refine, or leave out --tone."
        )
    names = list(solved.cameras)
    samples = sample_colors(shots, solved.observations, cameras=names)
    found = estimate_tones(samples, cameras=names, held_out=held_out)
    errors = found.errors
    return dict(found.curves), (
        f"colours differ by {errors.as_filmed:.1f} of 255 as filmed, {errors.with_gains:.1f} after gains, "
        f"{errors.with_curves:.1f} after curves"
    )


def moments_of(footage: Footage, clocks: Mapping[str, Clock], options: PrepareOptions) -> dict[str, Shots]:
    """Pictures of the moments that structure from motion looks at.

    Raises:
        CaptureError: the cameras have no moment in common.
    """
    first, last = shared_seconds(footage, clocks)
    return shots_of(footage, clocks, spread_moments(first, last, options.instants))


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
