# SPDX-License-Identifier: Apache-2.0
"""The steps that find the cameras: what they filmed, their clocks, poses and lenses, the unit of length."""

from collections.abc import Callable, Collection, Mapping
from dataclasses import asdict

from structgstream.data.calibration import listed
from structgstream.data.posed import Calibration
from structgstream.data.timeline import Clock
from structgstream.errors import ConfigError
from structgstream.frames import MIN_CAMERAS
from structgstream.preparation.calibrating import (
    check_complete,
    check_enough,
    described,
    focals_told,
    from_other_tool,
    packed,
    scaled,
    stated_focals,
    summary,
    turns_told,
    unpacked,
)
from structgstream.preparation.calibration.solved import SolvedCalibration
from structgstream.preparation.footage import Footage, find_footage
from structgstream.preparation.options import PrepareOptions
from structgstream.preparation.output_folder import claim
from structgstream.preparation.solvers import (
    TIMESTAMPS,
    Clocks,
    first_clocks,
    refined,
    solved_by,
    synchronized,
)
from structgstream.preparation.steps import Job, Stored, fingerprint


class CameraSteps:
    """The steps of one preparation up to a calibration in a unit.

    Args:
        job: what is prepared, and how.
    """

    def __init__(self, job: Job) -> None:
        self.videos, self.capture, self.options = job.videos, job.capture, job.options
        self.steps, self.listener = job.steps, job.listener

    def find(self) -> Footage:
        self.listener.begin("find", skipped=False)
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
        claim(self.capture, self.videos)
        turns = turns_told(footage)
        self.listener.end("find", _described(footage) + (f"; {turns}" if turns else ""))
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
                return synchronized(footage, self.options, cameras=from_other_tool(method, footage).cameras)
            # Pictures of a board are matched by their time, so there clocks must be known first.
            by_itself = method == "sfm" or self.options.board_videos is not None
            return (first_clocks if by_itself else synchronized)(footage, self.options)

        inputs = {
            "files": fingerprint(footage.files),
            "table": fingerprint({"table": table}) if (table := footage.where / TIMESTAMPS).is_file() else None,
            "fps": footage.fps,
            "how": self.options.synchronize,
            "calibration": method if isinstance(method, str) else described(method),
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
            step, inputs, find, pack=_packed_clocks, unpack=_unpacked_clocks, summary=lambda found: found.told,
            after=after,
        )  # fmt: skip

    def calibrate(self, footage: Footage, clocks: Clocks, method: str | Calibration) -> SolvedCalibration:
        options = self.options
        name = method if isinstance(method, str) else method.where.name
        inputs = {
            "method": method if isinstance(method, str) else described(method),
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
            lambda: (_first(method, footage, clocks, options, focals), focals_told(focals, footage)),
            said=lambda found, told: f"{name}: {summary(found)}" + (f"; {told}" if told else ""),
            after="synchronize",
        )
        last = "calibrate"
        if options.refine:
            solved = self._solved(
                last := "refine",
                {},
                lambda: refined(solved, footage, clocks, options),
                said=lambda found, told: told,
                after="calibrate",
            )
        return self._solved(
            "scale",
            {"distance": None if options.distance is None else asdict(options.distance)},
            lambda: (scaled(solved, options), ""),
            said=lambda found, told: "metres" if found.metres else "arbitrary units; --distance A B 3.2m gives metres",
            after=last,
        )

    def _solved(
        self,
        step: str,
        inputs: Mapping[str, object],
        solve: Callable[[], tuple[SolvedCalibration, str]],
        *,
        said: Callable[[SolvedCalibration, str], str],
        after: str,
    ) -> SolvedCalibration:
        def pack(found: tuple[SolvedCalibration, str]) -> Stored:
            stored = packed(found[0])
            return Stored({**stored.values, "told": found[1]}, stored.arrays)

        found = self.steps.run(
            step,
            inputs,
            solve,
            pack=pack,
            unpack=lambda stored: (unpacked(stored), str(stored.values["told"])),
            summary=lambda found: said(*found),
            after=(after,),
        )
        return found[0]


def _first(
    method: str | Calibration,
    footage: Footage,
    clocks: Clocks,
    options: PrepareOptions,
    focals: Mapping[str, float],
) -> SolvedCalibration:
    if isinstance(method, str):
        return check_complete(solved_by(method, footage, clocks, options, focals=focals), footage)
    return from_other_tool(method, footage)


def _packed_clocks(found: Clocks) -> Stored:
    return Stored(
        {
            "clocks": {name: asdict(clock) for name, clock in found.clocks.items()},
            "method": found.method,
            "told": found.told,
            "late_seconds": dict(found.late_seconds),
            "uncertainty_seconds": dict(found.uncertainty_seconds),
            "sure": found.sure,
        }
    )


def _unpacked_clocks(stored: Stored) -> Clocks:
    values = stored.values
    clocks = {name: Clock(**clock) for name, clock in values["clocks"].items()}
    return Clocks(
        clocks,
        values["method"],
        values["told"],
        values["late_seconds"],
        values["uncertainty_seconds"],
        values["sure"],
    )


def _described(footage: Footage) -> str:
    sizes = sorted({footage.size(name) for name in footage.cameras})
    shown = ", ".join(f"{width}x{height}" for width, height in sizes[:3])
    lengths = [len(footage.stamps(name)) for name in footage.cameras]
    frames = f"{min(lengths)}" if min(lengths) == max(lengths) else f"{min(lengths)} to {max(lengths)}"
    kind = "videos" if footage.tracks else "folders of pictures"
    return f"{len(footage.cameras)} {kind}, {shown}, {frames} frames, {footage.fps:g} a second"
