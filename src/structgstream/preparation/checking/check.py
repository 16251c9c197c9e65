# SPDX-License-Identifier: Apache-2.0
"""Checks a capture: poses, names, units, overlap, colours and times against its pictures."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from structgstream.cameras import Camera
from structgstream.data.camera_spacing import expectation
from structgstream.data.source import FrameSource, select_cameras
from structgstream.frames import MultiViewFrame
from structgstream.pose_check.check import Finding, examine_poses, explain, worst_first
from structgstream.pose_check.tracks import MIN_VIEWS, Evidence, Tracks, pair_errors
from structgstream.pose_check.verdicts import Suspects, Verdict
from structgstream.preparation.checking.bumps import bump_findings
from structgstream.preparation.checking.colors import Color, color_findings, compare_colors, exposure_findings
from structgstream.preparation.checking.overlap import (
    Coverage,
    coverage,
    nearest_depth,
    observed_depths,
    overlap_findings,
    overlaps,
    scale_findings,
)
from structgstream.preparation.checking.presence import (
    Presence,
    note,
    passed_frames,
    presence_findings,
    stated_presence,
    whole_frame,
)
from structgstream.preparation.checking.times import (
    MIN_FRAMES,
    SynchronizationCheck,
    check_synchronization,
    time_findings,
)
from structgstream.preparation.output_folder import Listener, Silent


@dataclass(frozen=True)
class PairCheck:
    """Matches of two pictures against the given poses."""

    first: str  # name of a camera
    second: str  # name of another
    matches: int  # good matches, found without the poses; 0 where the cameras see too little in common
    epipolar_pixels: float | None  # their median distance to the epipolar lines of the poses; None without matches
    share_violating: float | None  # share of them that the poses cannot explain; None without matches


@dataclass(frozen=True)
class CameraCheck:
    """What was found of one camera."""

    reprojection_pixels: float | None
    """Median distance of its keypoints to points that other cameras agree on; None without any."""
    reprojection_pixels_90: float | None  # their 90th percentile
    points: int  # number of these points
    overlaps: int  # number of cameras that it has matches with
    exposure_stops: float | None = None
    """Exposure relative to the median camera, as a power of two; None without matches."""
    red_stops: float | None = None  # red against green, relative to the median camera
    blue_stops: float | None = None  # blue against green, relative to the median camera
    offset_ms: float | None = None  # time against the other cameras, milliseconds; None where it was not estimated
    offset_uncertainty_ms: float | None = None  # its standard deviation
    frames_lacking: int = 0  # number of the capture's frames that it has no picture of


@dataclass(frozen=True)
class CheckReport:
    """The numbers of a check; ``as_json`` is what ``report.json`` holds. Lengths are in the capture's units.

    Args:
        capture: its name.
        frame: the frame that was looked at.
        cameras: by name, in the order of the rig.
        pairs: all pairs that were matched.
        findings: the worst first.
        nearest: depth that 0.5 % of the points fall below; None without points.
        unit: of length, where the capture states it.
        steps: summaries of the preparation's steps, where there was one.
    """

    capture: str
    frame: int
    cameras: Mapping[str, CameraCheck]
    pairs: tuple[PairCheck, ...]
    coverage: Coverage
    findings: tuple[Finding, ...]
    rig_radius: float
    near: float
    nearest: float | None
    unit: str | None = None
    steps: Mapping[str, Any] = field(default_factory=dict)

    @property
    def median_epipolar_pixels(self) -> float | None:
        """Median over pairs, or None without matches."""
        known = sorted(pair.epipolar_pixels for pair in self.pairs if pair.epipolar_pixels is not None)
        return known[len(known) // 2] if known else None

    def as_json(self) -> dict[str, Any]:
        """Plain values, with the median over pairs."""
        return asdict(self) | {"median_epipolar_pixels": self.median_epipolar_pixels}


MIN_TIMED = 3  # cameras, for times that can be compared
FAR_AWAY = 30.0  # radii of the rig: a camera that stands further away is in another unit


@dataclass(frozen=True)
class Examination:
    """All that was found at one instant; the pictures of a report are drawn from it."""

    frame: MultiViewFrame
    cameras: Mapping[str, Camera]
    evidence: Evidence
    verdict: Verdict
    colors: Mapping[str, Color]
    presence: Presence = field(default_factory=dict)  # by camera, which frames of the capture it has a picture of

    @property
    def suspects(self) -> Suspects:
        """Cameras that are off."""
        return self.verdict.suspects

    @property
    def tracks(self) -> Tracks:
        """Points of the cameras that are not off."""
        return self.verdict.tracks


@dataclass(frozen=True)
class Checked:
    """A check: numbers and sentences, and what they came from."""

    report: CheckReport
    examination: Examination


def examine(frame: MultiViewFrame, cameras: Mapping[str, Camera]) -> Examination:
    """Matches one instant's pictures and holds them against the poses."""
    seen = {name: camera for name, camera in cameras.items() if name in frame.images}
    evidence, verdict = examine_poses(frame, seen)
    return Examination(frame, seen, evidence, verdict, compare_colors(evidence))


def examine_capture(source: FrameSource) -> Examination:
    """The examination of the first frame of a capture that all cameras have."""
    presence = stated_presence(source)
    return replace(examine(whole_frame(source, presence), source.rig.cameras), presence=presence)


def check_capture(
    source: FrameSource,
    *,
    unit: str | None = None,
    listener: Listener | None = None,
    examination: Examination | None = None,
) -> Checked:
    """Checks the first frame that all cameras have and the last; held-out cameras are checked, too. ``unit`` is that of
    length, where it is known."""
    cameras = source.rig.cameras
    listener = listener or Silent()
    listener.progress(0, 3, "first frame")
    first = examination or examine_capture(source)
    presence = {name: present.copy() for name, present in first.presence.items()}
    findings = explain(first.evidence, first.cameras, first.verdict)
    findings += overlap_findings(first.evidence.overlapping(), list(first.cameras))
    if expected := expectation({name: cameras[name] for name in source.rig.training}):
        findings.append(Finding("warning" if expected.poor else "note", expected.sentence))
    depths = observed_depths(first.tracks, first.cameras, off=first.suspects.off)
    off = () if first.suspects.everything else first.suspects.off
    centers = np.stack([camera.center.numpy() for name, camera in first.cameras.items() if name not in off])
    middle = centers.mean(0)
    radius = float(np.linalg.norm(centers - middle, axis=1).max())
    if not first.suspects.everything:
        seen = {name: cameras[name] for name in first.cameras}  # with the near plane of now
        # A camera that is off may stand as in another unit: points that were estimated with it are as wrong.
        away = [float(np.linalg.norm(first.cameras[name].center.numpy() - middle)) for name in off]
        points = None if max(away, default=0.0) > FAR_AWAY * radius else source.points
        findings += scale_findings(depths, points, seen, radius=radius, unit=unit)
    findings += color_findings(first.colors)
    listener.progress(1, 3, "last frame")
    if (end := len(source) - 1) > first.frame.index:
        last = next(source.frames(end))
        note(last, presence)
        findings += bump_findings(first.frame, last, first.evidence, first.cameras)
        findings += exposure_findings(first.frame, last)
    findings += presence_findings(presence, source.fps, passed=passed_frames(source))
    listener.progress(2, 3, "times")
    times = _measured_times(source, first.suspects)
    findings += time_findings(times)
    listener.progress(3, 3, "")
    solid = first.tracks.points[first.tracks.views >= MIN_VIEWS]
    report = CheckReport(
        capture=source.name,
        frame=first.frame.index,
        cameras=_camera_checks(first, source, times, presence),
        pairs=_pair_checks(first),
        coverage=coverage(solid if len(solid) else first.tracks.points, first.cameras),
        findings=worst_first(findings),
        rig_radius=radius,
        near=float(np.median([camera.near for camera in cameras.values()])),
        nearest=nearest_depth(depths),
        unit=unit,
    )
    return Checked(report, first)


def _measured_times(source: FrameSource, suspects: Suspects) -> SynchronizationCheck | None:
    """Of the cameras whose poses are right: epipolar lines of a wrong pose give no times."""
    good = tuple(name for name in source.rig if name not in suspects.off)
    if suspects.everything or len(good) < MIN_TIMED or len(source) < MIN_FRAMES:
        return None
    return check_synchronization(select_cameras(source, good) if suspects.off else source)


def _camera_checks(
    examined: Examination, source: FrameSource, times: SynchronizationCheck | None, presence: Presence
) -> dict[str, CameraCheck]:
    tracks, views = examined.tracks, examined.tracks.views
    counts = overlaps(examined.evidence.overlapping(), list(examined.cameras))
    late = {} if times is None else times.late_against_others
    found = {}
    for name in source.rig:
        color = examined.colors.get(name)
        solid = tracks.of(name) & (views[tracks.point] >= MIN_VIEWS) & np.isfinite(tracks.residuals)
        residuals = tracks.residuals[solid]
        found[name] = CameraCheck(
            reprojection_pixels=float(np.median(residuals)) if len(residuals) else None,
            reprojection_pixels_90=float(np.percentile(residuals, 90)) if len(residuals) else None,
            points=len(residuals),
            overlaps=counts.get(name, 0),
            **(asdict(color) if color else {}),
            offset_ms=1e3 * late[name] if name in late else None,
            offset_uncertainty_ms=1e3 * times.uncertainty_seconds[name] if times is not None and name in late else None,
            frames_lacking=int((~presence[name]).sum()),
        )
    return found


def _pair_checks(examined: Examination) -> tuple[PairCheck, ...]:
    errors = pair_errors(examined.evidence, examined.cameras)
    checks = {pair: PairCheck(*pair, error.matches, error.pixels, error.share) for pair, error in errors.items()}
    return tuple(checks.get(pair) or PairCheck(*pair, 0, None, None) for pair in examined.evidence.matches)
