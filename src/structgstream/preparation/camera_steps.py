# SPDX-License-Identifier: Apache-2.0
"""The steps that find the cameras: what they filmed, their clocks, poses and lenses, the unit of length."""

from collections.abc import Callable, Collection, Mapping
from dataclasses import asdict
from pathlib import Path

from structgstream.data.calibration import Calibration, listed
from structgstream.errors import CalibrationError, ConfigError
from structgstream.frames import MIN_CAMERAS
from structgstream.preparation.calibration.solved import SolvedCalibration, with_distance
from structgstream.preparation.clocks import (
    TIMESTAMPS,
    Clocks,
    first_clocks,
    packed_clocks,
    synchronized,
    unpacked_clocks,
)
from structgstream.preparation.footage import Footage, find_footage
from structgstream.preparation.options import METHODS, PrepareOptions
from structgstream.preparation.output_folder import mark_output
from structgstream.preparation.solvers import (
    calibration_key,
    check_complete,
    describe_focals,
    describe_turns,
    find_calibration,
    given_cameras,
    packed,
    refined,
    require_calibration,
    solve_cameras,
    stated_focals,
    summary,
    unpacked,
)
from structgstream.preparation.steps import Job, Stored, fingerprint

MIN_SOLVED = 3  # cameras, for poses that can be checked


class CameraSteps:
    """The steps of one preparation up to a calibration in a unit.

    Args:
        job: what is prepared, and how.
    """

    def __init__(self, job: Job) -> None:
        self.videos, self.capture, self.options = job.videos, job.capture, job.options
        self.steps = job.steps

    def find(self) -> Footage:
        self.steps.begin("find")
        footage = find_footage(self.videos, picture_fps=self.options.fps)
        self._check_names(self.options.without, footage, purpose="leave out")
        footage = footage.only([name for name in footage.cameras if name not in self.options.without])
        held_out, distance = self.options.held_out, self.options.distance
        self._check_names(() if held_out == ("auto",) else held_out, footage, purpose="hold out")
        self._check_names(
            () if distance is None else (distance.first, distance.second), footage, purpose="measure from"
        )
        check_enough(footage)
        self._check_trained(footage)
        mark_output(self.capture, self.videos)
        turns = describe_turns(footage)
        self.steps.end("find", _described(footage) + (f"; {turns}" if turns else ""))
        return footage

    def _check_names(self, names: Collection[str], footage: Footage, *, purpose: str) -> None:
        """Refuses cameras that are not there, before anything takes time."""
        if unknown := [name for name in names if name not in footage.cameras]:
            raise ConfigError(
                f"{self.videos} has no {listed(unknown)} to {purpose}; its cameras are {', '.join(footage.cameras)}."
            )

    def _check_trained(self, footage: Footage) -> None:
        """Refuses to hold out more cameras than can be spared, before anything takes time."""
        held_out = set(self.options.held_out) - {"auto"}
        if len(footage.cameras) - len(held_out) < MIN_CAMERAS:
            raise ConfigError(
                f"{self.videos} has {len(footage.cameras)} cameras, {len(held_out)} of them held out; a reconstruction "
                f"needs {MIN_CAMERAS} or more to train on: hold out fewer."
            )

    def synchronize(self, footage: Footage, method: str | Calibration) -> Clocks:
        """The clocks; by motion they may be unsure until the calibration is known."""

        def find() -> Clocks:
            if not isinstance(method, str):
                return synchronized(footage, self.options, cameras=given_cameras(method, footage).cameras)
            # Pictures of a board are matched by their time, so there clocks must be known first.
            by_itself = method == "sfm" or self.options.board_videos is not None
            return (first_clocks if by_itself else synchronized)(footage, self.options)

        inputs = {
            "files": fingerprint(footage.files),
            "table": fingerprint({"table": table}) if (table := footage.where / TIMESTAMPS).is_file() else None,
            "fps": footage.fps,
            "how": self.options.synchronize,
            "calibration": method if isinstance(method, str) else calibration_key(method),
            "board": self.options.board_videos is not None,
        }
        return self._clocks("synchronize", inputs, find)

    def synchronize_again(
        self, footage: Footage, clocks: Clocks, method: str | Calibration, solved: SolvedCalibration
    ) -> Clocks:
        """By motion again when the calibration is known, which makes it exact.

        Raises:
            CaptureError: not even so.
        """
        if clocks.method != "motion" or not isinstance(method, str):
            return clocks
        return self._clocks(
            "clocks",
            {},
            lambda: synchronized(footage, self.options, cameras=solved.cameras),
            after=("scale",),
        )

    def _clocks(
        self, step: str, inputs: Mapping[str, object], find: Callable[[], Clocks], after: tuple[str, ...] = ()
    ) -> Clocks:
        return self.steps.run(
            step, inputs, find, pack=packed_clocks, unpack=unpacked_clocks, summary=lambda found: found.summary,
            after=after,
        )  # fmt: skip

    def calibrate(self, footage: Footage, clocks: Clocks, method: str | Calibration) -> SolvedCalibration:
        options = self.options
        name = method if isinstance(method, str) else method.where.name
        inputs = {
            "method": method if isinstance(method, str) else calibration_key(method),
            "board": asdict(options.board),
            "lens": options.lens,
            "intrinsics": options.intrinsics,
            "board_videos": None if options.board_videos is None else fingerprint({"board": options.board_videos}),
            "instants": options.instants,
        }
        focals = stated_focals(footage) if method == "sfm" else {}
        if focals:
            inputs["focals"] = focals
        solved = self._solved(
            "calibrate",
            inputs,
            lambda: (_first(method, footage, clocks, options, focals), describe_focals(focals, footage)),
            describe=lambda found, detail: f"{name}: {summary(found)}" + (f"; {detail}" if detail else ""),
            after="synchronize",
        )
        last = "calibrate"
        if options.refine:
            solved = self._solved(
                last := "refine",
                {},
                lambda: refined(solved, footage, clocks, options),
                describe=lambda found, detail: detail,
                after="calibrate",
            )
        distance = options.distance

        def scale() -> tuple[SolvedCalibration, str]:
            if distance is None:
                return solved, ""
            return with_distance(solved, distance.first, distance.second, metres=distance.metres), ""

        return self._solved(
            "scale",
            {"distance": None if distance is None else asdict(distance)},
            scale,
            describe=lambda found, _: "metres" if found.metres else "arbitrary units; --distance A B 3.2m gives metres",
            after=last,
        )

    def _solved(
        self,
        step: str,
        inputs: Mapping[str, object],
        solve: Callable[[], tuple[SolvedCalibration, str]],
        *,
        describe: Callable[[SolvedCalibration, str], str],
        after: str,
    ) -> SolvedCalibration:
        def pack(found: tuple[SolvedCalibration, str]) -> Stored:
            stored = packed(found[0])
            return Stored({**stored.values, "detail": found[1]}, stored.arrays)

        found = self.steps.run(
            step,
            inputs,
            solve,
            pack=pack,
            unpack=lambda stored: (unpacked(stored), str(stored.values.get("detail", stored.values.get("told", "")))),
            summary=lambda found: describe(*found),
            after=(after,),
        )
        return found[0]


def chosen_method(footage: Footage, options: PrepareOptions) -> str | Calibration:
    """``sfm``, ``board``, or the calibration to use.

    Raises:
        CalibrationError: the requested calibration is missing or broken.
    """
    if str(options.calibration) not in METHODS:
        return require_calibration(Path(options.calibration))
    if options.calibration != "auto":
        return str(options.calibration)
    if options.board_videos is not None:
        return "board"
    return find_calibration(footage.where) or "sfm"


def check_used(method: str | Calibration, footage: Footage, options: PrepareOptions) -> None:
    """
    Raises:
        ConfigError: an option has no effect, so that its user expects another capture.
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


def check_enough(footage: Footage) -> None:
    """
    Raises:
        CalibrationError: too few cameras for poses that can be checked.
    """
    if len(footage.cameras) < MIN_SOLVED:
        raise CalibrationError(
            f"{footage.where} has {listed(footage.cameras)} alone; a capture needs {MIN_SOLVED} or more, as two "
            "cameras cannot confirm each other's calibration: film with more."
        )


def _first(
    method: str | Calibration,
    footage: Footage,
    clocks: Clocks,
    options: PrepareOptions,
    focals: Mapping[str, float],
) -> SolvedCalibration:
    if isinstance(method, str):
        return check_complete(solve_cameras(method, footage, clocks, options, focals=focals), footage)
    return given_cameras(method, footage)


def _described(footage: Footage) -> str:
    sizes = sorted({footage.size(name) for name in footage.cameras})
    shown = ", ".join(f"{width}x{height}" for width, height in sizes[:3])
    lengths = [len(footage.stamps(name)) for name in footage.cameras]
    frames = f"{min(lengths)}" if min(lengths) == max(lengths) else f"{min(lengths)} to {max(lengths)}"
    kind = "videos" if footage.tracks else "folders of pictures"
    return f"{len(footage.cameras)} {kind}, {shown}, {frames} frames, {footage.fps:g} a second"
