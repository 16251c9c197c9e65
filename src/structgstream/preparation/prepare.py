# SPDX-License-Identifier: Apache-2.0
"""From videos of still cameras to a calibrated capture, step by step; steps that were done are not done again.

:func:`check_folder` is the last step for a capture of any layout.
"""

import json
from collections.abc import Collection, Mapping
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from structgstream.atomic_files import atomic_file
from structgstream.cameras import NEAR_IN_RIG_RADII, CameraRig, rig_radius
from structgstream.data.calibration import Calibration, listed
from structgstream.data.camera_files import REPORT
from structgstream.data.camera_spacing import best_surrounded
from structgstream.data.masks import FOLDER as MASKS
from structgstream.data.masks import masks_folder
from structgstream.data.open import open_capture
from structgstream.data.prepared import (
    ROVING,
    PreparedCamera,
    PreparedCapture,
    Unit,
    prepared_entries,
    prepared_rig,
    read_prepared,
    recognizes_prepared,
    write_prepared,
)
from structgstream.data.roving import frame_points
from structgstream.data.source import FrameSource, WithRig
from structgstream.data.timeline import Clock
from structgstream.data.undistortion import rectilinear
from structgstream.data.video import measured_fps
from structgstream.errors import CalibrationError, CaptureError, ConfigError
from structgstream.frames import MIN_CAMERAS
from structgstream.owned_folders import own_folder
from structgstream.pose_check.check import Finding
from structgstream.preparation.calibration.board import Board
from structgstream.preparation.calibration.solved import SolvedCalibration, with_distance
from structgstream.preparation.checking.check import Checked, Examination, check_capture, examine_capture
from structgstream.preparation.checking.overlap import nearest_depth, observed_depths
from structgstream.preparation.footage import Footage, find_footage, frames_named, open_roving, write_png
from structgstream.preparation.options import METHODS, PrepareOptions
from structgstream.preparation.output_folder import (
    FOLDER,
    Listener,
    Packing,
    Silent,
    Steps,
    Stored,
    fingerprint,
    link,
    lock_output,
    mark_output,
    plain,
    remove_others,
    unlink,
)
from structgstream.preparation.report import PURPOSE, write_report
from structgstream.preparation.solvers import (
    CALIBRATION,
    CLOCKS,
    REFINED,
    Clocks,
    board_footage,
    calibration_key,
    check_complete,
    describe_focals,
    describe_turns,
    find_calibration,
    find_timestamps,
    first_clocks,
    given_cameras,
    refined,
    require_calibration,
    solve_cameras,
    stated_focals,
    summary,
    synchronized,
)
from structgstream.preparation.sound import best_microphone, recording

MIN_SOLVED = 3  # cameras, for poses that can be checked
POINTS = "points.npy"
NEAR_SHARE = 0.5  # of the depth of the nearest points: what comes closer later is still drawn


class Job:
    """One preparation of ``capture`` from the folder ``videos``: its steps, in their order."""

    def __init__(self, videos: Path, capture: Path, options: PrepareOptions, steps: Steps) -> None:
        self.videos, self.capture, self.options, self.steps = videos, capture, options, steps
        self.examination: Examination | None = None  # which two steps look at
        self.roving = None if options.roving is None else open_roving(options.roving)
        self._opened: FrameSource | None = None

    def find(self) -> Footage:
        """The cameras; unknown names in the options and too few cameras are refused before anything takes time."""
        self.steps.begin("find")
        options, distance = self.options, self.options.distance
        held_out = () if options.held_out == ("auto",) else options.held_out
        footage = find_footage(self.videos, picture_fps=options.fps)
        self._check_names(options.without, footage, purpose="leave out")
        # A roving video that lies among the others is none of the still cameras'.
        walked = None if options.roving is None else options.roving.resolve()
        still = [name for name in footage.cameras if footage.files[name].resolve() != walked]
        footage = footage.only([name for name in still if name not in options.without])
        self._check_names(held_out, footage, purpose="hold out")
        self._check_names(
            () if distance is None else (distance.first, distance.second), footage, purpose="measure from"
        )
        if len(footage.cameras) < MIN_SOLVED:
            raise CalibrationError(
                f"{self.videos} has {listed(footage.cameras)} alone; a capture needs {MIN_SOLVED} or more, as two "
                "cameras cannot confirm each other's calibration: film with more."
            )
        if len(footage.cameras) - len(set(held_out)) < MIN_CAMERAS:
            raise ConfigError(
                f"{self.videos} has {len(footage.cameras)} cameras, {len(set(held_out))} of them held out; a "
                f"reconstruction needs {MIN_CAMERAS} or more to train on: hold out fewer."
            )
        mark_output(self.capture, self.videos)
        turns = describe_turns(footage)
        self.steps.end("find", _described(footage) + (f"; {turns}" if turns else ""))
        return footage

    def _check_names(self, names: Collection[str], footage: Footage, *, purpose: str) -> None:
        if unknown := [name for name in names if name not in footage.cameras]:
            raise ConfigError(
                f"{self.videos} has no {listed(unknown)} to {purpose}; its cameras are {', '.join(footage.cameras)}."
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
            "table": None if (table := find_timestamps(footage)) is None else fingerprint({"table": table}),
            "fps": footage.fps,
            "how": self.options.synchronize,
            "calibration": method if isinstance(method, str) else calibration_key(method),
            "board": self.options.board_videos is not None,
        }
        return self.steps.run("synchronize", inputs, find, CLOCKS, summary=lambda found: found.summary)

    def synchronize_again(
        self, footage: Footage, clocks: Clocks, method: str | Calibration, solved: SolvedCalibration
    ) -> Clocks:
        """By motion again when the calibration is known, which makes it exact."""
        if clocks.method != "motion" or not isinstance(method, str):
            return clocks
        again = partial(synchronized, footage, self.options, cameras=solved.cameras)
        return self.steps.run("clocks", {}, again, CLOCKS, summary=lambda found: found.summary, after=("scale",))

    def calibrate(self, footage: Footage, clocks: Clocks, method: str | Calibration) -> SolvedCalibration:
        """Poses, intrinsics and lenses, refined and in a unit where that is asked for."""
        options, distance = self.options, self.options.distance
        name = method if isinstance(method, str) else method.where.name
        inputs = {
            "method": method if isinstance(method, str) else calibration_key(method),
            "board": asdict(options.board),
            "lens": options.lens,
            "intrinsics": options.intrinsics,
            "board_videos": None if options.board_videos is None else fingerprint({"board": options.board_videos}),
            "instants": options.instants,
        }
        if self.roving is not None:
            inputs["roving"] = fingerprint(self.roving.files)
        focals = stated_focals(footage) if method == "sfm" else {}
        if focals:
            inputs["focals"] = focals

        detail = describe_focals(focals, footage)

        def solve() -> SolvedCalibration:
            if not isinstance(method, str):
                return given_cameras(method, footage)
            found = solve_cameras(method, footage, clocks, options, focals=focals, roving=self.roving)
            return check_complete(found, footage)

        calibrated = self.steps.run(
            "calibrate", inputs, solve, CALIBRATION, after=("synchronize",),
            summary=lambda found: f"{name}: {summary(found)}" + (f"; {detail}" if detail else ""),
        )  # fmt: skip
        if options.refine:
            refine = partial(refined, calibrated, footage, clocks, options)
            calibrated, _ = self.steps.run(
                "refine", {}, refine, REFINED, summary=lambda found: found[1], after=("calibrate",)
            )

        def scale() -> SolvedCalibration:
            if distance is None:
                return calibrated
            return with_distance(calibrated, distance.first, distance.second, metres=distance.metres)

        return self.steps.run(
            "scale", {"distance": None if distance is None else asdict(distance)}, scale, CALIBRATION,
            summary=lambda found: "metres" if found.metres else "arbitrary units; --distance A B 3.2m gives metres",
            after=("refine" if options.refine else "calibrate",),
        )  # fmt: skip

    def link(self, footage: Footage, content: PreparedCapture) -> None:
        self.steps.begin("link")
        for number, (name, camera) in enumerate(content.cameras.items()):
            self.steps.progress(number, len(content.cameras), name)
            target = self.capture / camera.files
            source = footage.files[name]
            if not footage.tracks and source.is_file():
                target = target / source.name
            link(source, target, how=self.options.link)
            if not footage.tracks:
                remove_others(self.capture / camera.files, [file.name for file in footage.stills[name]])
        self._link_masks()
        write_prepared(self.capture, content)
        how = {"hard": "hard link or copy", "symlink": "symlink", "copy": "copy"}[self.options.link]
        self.steps.end("link", f"{len(content.cameras)} cameras by {how}")

    def roving_pictures(self, content: PreparedCapture) -> None:
        """Writes those of the registered frames; others, of an earlier run, are removed."""
        names = [f"{name}.png" for name in content.roving]
        if self.roving is not None:
            footage, result = self.roving, self.capture / FOLDER / f"{ROVING}.json"

            def write() -> int:
                result.unlink(missing_ok=True)  # an interruption leaves pictures of two videos, whose names are alike
                for number, (name, picture) in enumerate(frames_named(footage, content.roving)):
                    self.steps.progress(number, len(names), name)
                    write_png(self.capture / f"{name}.png", picture)
                return len(names)

            if not all((self.capture / name).is_file() for name in names):
                result.unlink(missing_ok=True)
            self.steps.run(
                ROVING, {}, write, plain("count"), summary=lambda count: f"{count} pictures", after=("calibrate",)
            )
        if (folder := self.capture / ROVING).is_dir():
            remove_others(folder, [Path(name).name for name in names])

    def _link_masks(self) -> None:
        """All masks but those of cameras that are left out; these are removed where an earlier run linked them."""
        folder = masks_folder(self.videos)
        for entry in sorted(folder.iterdir()) if folder.is_dir() else ():
            target = self.capture / MASKS / entry.name
            if (entry.name if entry.is_dir() else entry.stem) in self.options.without:
                unlink(entry, target)
            else:
                link(entry, target, how=self.options.link)

    def near(self, content: PreparedCapture) -> PreparedCapture:
        """With the near plane from the points that pictures confirm."""
        if self.options.near is not None:
            return content

        def measure() -> float | None:
            self.examination = examine_capture(self._source(content))
            return nearest_depth(observed_depths(self.examination.tracks, self.examination.cameras))

        nearest = self.steps.run(
            "near",
            self._inputs(content),
            measure,
            plain("nearest"),
            summary=lambda found: "too few points: 0.12 rig radii" if found is None
            else f"{NEAR_SHARE * found:.3g}, half of the depth of the nearest points",
            after=("synchronize",),
        )  # fmt: skip
        content = content if nearest is None else replace(content, near=NEAR_SHARE * nearest)
        write_prepared(self.capture, content)
        return content

    def points(self, content: PreparedCapture) -> PreparedCapture:
        def estimate() -> NDArray[np.float64]:
            source = self._source(content)
            return frame_points(source, next(source.frames(0)))

        found = self.steps.run(
            "points",
            self._inputs(content),
            estimate,
            Packing(lambda points: Stored({}, {"points": points}), lambda stored: stored.arrays["points"]),
            summary=lambda points: f"{len(points):,} points of frame 0",
            after=("synchronize",),
        )
        with atomic_file(self.capture / POINTS) as file:
            np.save(file, found)
        content = replace(content, points=POINTS)
        write_prepared(self.capture, content)
        return content

    def sound(self, footage: Footage, content: PreparedCapture) -> None:
        """Chooses the camera whose sound streams get."""
        if not footage.tracks:
            return
        found = self.steps.run(
            "sound",
            {"files": fingerprint(footage.files)},
            lambda: best_microphone((name, recording(footage.files[name])) for name in footage.cameras),
            plain("camera"),
            summary=lambda camera: "no camera has any" if camera is None else f"the microphone of {camera} is the best",
        )
        if found is not None:
            write_prepared(self.capture, replace(content, sound=found))

    def check(self, content: PreparedCapture) -> tuple[Finding, ...]:
        result = self.capture / FOLDER / "check.json"

        def look() -> tuple[Finding, ...]:
            result.unlink(missing_ok=True)  # an interruption leaves a page of another result
            source = self._source(content)
            checked = check_capture(source, unit=content.unit, listener=self.steps, examination=self.examination)
            checked = replace(checked, report=replace(checked.report, steps=dict(self.steps.summaries)))
            write_report(self.capture / REPORT, checked, listener=self.steps)
            return checked.report.findings

        if not (self.capture / REPORT / "index.html").is_file():
            result.unlink(missing_ok=True)
        return self.steps.run(
            "check",
            self._inputs(content),
            look,
            Packing(
                lambda findings: Stored({"findings": [asdict(finding) for finding in findings]}),
                lambda stored: tuple(
                    Finding(**{**found, "cameras": tuple(found["cameras"])}) for found in stored.values["findings"]
                ),
            ),
            summary=lambda findings: f"{len(findings)} finding{'s' * (len(findings) != 1)}; {REPORT}/index.html",
            after=("points",),
        )

    def _inputs(self, content: PreparedCapture) -> dict[str, object]:
        """All that frames depend on, but for what was filmed."""
        inputs: dict[str, object] = {"content": json.dumps(prepared_entries(content))}
        if (masks := self.capture / MASKS).is_dir():
            inputs["masks"] = fingerprint({"masks": masks})
        return inputs

    def _source(self, content: PreparedCapture) -> FrameSource:
        """The capture, opened once: indexing videos takes time, and its warnings should come once."""
        if self._opened is None:
            self._opened = open_capture(self.capture)
        points = None
        if content.points is not None:
            points = np.asarray(np.load(self.capture / content.points, allow_pickle=False), np.float64)
        return _Grown(self._opened, prepared_rig(self.capture, content), points)


@dataclass(frozen=True)
class _Grown(WithRig):
    """An opened capture with the near plane and the points that were found since."""

    found: NDArray[np.float64] | None

    @property
    def points(self) -> NDArray[np.float64] | None:
        return self.found


def chosen_method(footage: Footage, options: PrepareOptions) -> str | Calibration:
    """``sfm``, ``board``, or the calibration to use."""
    if str(options.calibration) not in METHODS:
        return require_calibration(Path(options.calibration))
    if options.calibration != "auto":
        return str(options.calibration)
    if options.board_videos is not None:
        return "board"
    return find_calibration(footage.where) or "sfm"


SQUARE = 0.01
"""Share by which pixels may differ from squares: whole numbers of pixels make ratios as 2025:2024."""


def check_used(method: str | Calibration, footage: Footage, options: PrepareOptions) -> None:
    """Refuses options that would have no effect, since their user expects one, and what a later step would refuse after
    minutes of work."""
    if options.fps is not None and footage.tracks:
        raise ConfigError(
            f"The videos of {footage.where} state the time of each frame, and --fps is the rate of folders of "
            "pictures; leave out --fps."
        )
    wide = next((track for track in footage.tracks.values() if abs(track.pixel_aspect - 1) > SQUARE), None)
    if wide is not None and isinstance(method, str):
        raise CaptureError(
            f"The pixels of the video {wide.path} are {wide.pixel_aspect:.3g} times as wide as high (anamorphic), and "
            "calibration expects square ones; write it again with square pixels (scale=iw*sar:ih,setsar=1 of FFmpeg), "
            "keeping the time of each frame, or give a calibration of another tool."
        )
    if options.board_videos is not None and method != "board":
        raise ConfigError(
            "Videos of a board (--board-videos) calibrate by --calibration board alone; choose that, or leave them out."
        )
    if method == "board" and options.board_videos is not None:
        board_footage(footage, options)  # raises
    if options.board != Board() and method != "board":
        raise ConfigError("A board (--board) is looked for by --calibration board alone; choose that, or leave it out.")
    if options.intrinsics != "own" and method != "sfm":
        raise ConfigError(
            "Shared intrinsics (--intrinsics) are estimated by structure from motion alone; choose --calibration sfm, "
            "or leave them out."
        )
    if options.roving is not None and method != "sfm":
        raise ConfigError(
            "A roving video (--roving) is registered by structure from motion alone; choose --calibration sfm, or "
            "leave it out."
        )
    if options.roving is not None and options.refine:
        raise ConfigError(
            "Refining (--refine) adjusts the still cameras alone, so the frames of a roving video (--roving) would no "
            "longer fit them; leave out one of the two."
        )
    if options.lens == "brown" and options.refine:
        raise ConfigError(
            "Lenses of the model brown cannot be refined; take --lens opencv, or leave out --refine or --lens."
        )
    if options.lens is not None and isinstance(method, Calibration) and not options.refine:
        raise ConfigError(
            f"{method.where} states the lenses, so --lens {options.lens} has no effect; add --refine to adjust them to "
            "the pictures, choose --calibration sfm, or leave out --lens."
        )


def _described(footage: Footage) -> str:
    sizes = sorted({footage.size(name) for name in footage.cameras})
    shown = ", ".join(f"{width}x{height}" for width, height in sizes[:3])
    lengths = [len(footage.stamps(name)) for name in footage.cameras]
    frames = f"{min(lengths)}" if min(lengths) == max(lengths) else f"{min(lengths)} to {max(lengths)}"
    kind = "videos" if footage.tracks else "folders of pictures"
    return f"{len(footage.cameras)} {kind}, {shown}, {frames} frames, {footage.fps:g} a second"


def assembled(
    footage: Footage, clocks: Mapping[str, Clock], solved: SolvedCalibration, options: PrepareOptions
) -> PreparedCapture:
    """The content of ``capture.json`` with the usual near plane, without points."""
    fps = measured_fps(footage.tracks, clocks) if footage.tracks else None
    if not footage.tracks:
        # Pictures are counted at the rate of the capture, which is that of most cameras by their clocks.
        usual = float(np.median([clocks.get(name, Clock()).rate for name in footage.cameras]))
        fps = footage.fps / usual
        clocks = {name: replace(clock, rate=clock.rate / usual) for name, clock in clocks.items()}
    cameras = {}
    for name in footage.cameras:
        filmed = solved.cameras[name]
        pinhole = rectilinear(filmed, degrees=options.field_of_view, size=options.size)
        where = f"videos/{name}{footage.files[name].suffix.lower()}" if footage.tracks else f"pictures/{name}"
        cameras[name] = PreparedCamera(where, filmed, pinhole, clocks.get(name, Clock()))
    rig = CameraRig({name: camera.pinhole for name, camera in cameras.items()})
    held_out = frozenset({best_surrounded(rig)} if options.held_out == ("auto",) else options.held_out)
    near = options.near or NEAR_IN_RIG_RADII * rig_radius(rig.with_held_out(held_out))
    walked = {} if solved.roving is None else solved.roving.cameras
    roving = {name: PreparedCamera(f"{name}.png", filmed, rectilinear(filmed)) for name, filmed in walked.items()}
    unit: Unit = "metres" if solved.metres else "arbitrary"
    return PreparedCapture(cameras, fps or footage.fps, near, unit, held_out, roving=roving)


@dataclass(frozen=True)
class Preparation:
    """A capture that was prepared.

    Args:
        path: its folder, for ``open_capture`` and ``reconstruct``.
        findings: of the check, errors first.
        steps: summaries of the steps.
        skipped: steps whose results were there already.
        report: the page of the report.
    """

    path: Path
    findings: tuple[Finding, ...]
    steps: Mapping[str, str]
    skipped: tuple[str, ...]
    report: Path


def prepare_capture(
    videos: Path, capture: Path, *, options: PrepareOptions | None = None, listener: Listener | None = None
) -> Preparation:
    """Makes the capture, or goes on with one that was interrupted; the same call again does only what has changed.

    Args:
        videos: the folder of the cameras' videos or pictures, see ``preparation.footage``.
        capture: the folder to make.
        listener: receives steps and progress.

    Raises:
        CaptureError: the videos cannot be read, synchronised or calibrated, or ``capture`` holds something else.
        ConfigError: options that the cameras do not allow.
        StorageError: the capture cannot be written.
    """
    options = options or PrepareOptions()
    job = Job(videos, capture, options, Steps(capture, listener or Silent()))
    footage = job.find()
    method = chosen_method(footage, options)
    check_used(method, footage, options)
    if method == "board":
        options.board.opencv_board()  # raises, before anything takes time, for markers that OpenCV does not have
    with lock_output(capture):
        first = job.synchronize(footage, method)
        solved = job.calibrate(footage, first, method)
        clocks = job.synchronize_again(footage, first, method, solved)
        content = assembled(footage, clocks.clocks, solved, options)
        job.roving_pictures(content)
        job.link(footage, content)
        content = job.points(job.near(content))
        findings = job.check(content)
        job.sound(footage, content)
    report = capture / REPORT / "index.html"
    return Preparation(capture, findings, job.steps.summaries, tuple(job.steps.skipped), report)


def check_folder(path: Path, *, report: Path | None, listener: Listener | None = None) -> Checked:
    """The check of a capture, whose report goes to the folder ``report``; None writes none."""
    listener = listener or Silent()
    listener.begin("check", skipped=False)
    unit = read_prepared(path).unit if recognizes_prepared(path) else None
    source = open_capture(path)
    if report is not None:
        own_folder(report, PURPOSE)  # before the check, which takes minutes
    checked = check_capture(source, unit=unit, listener=listener)
    if report is not None:
        write_report(report, checked, listener=listener)
    listener.end("check", f"{len(checked.report.findings)} findings")
    return checked
