# SPDX-License-Identifier: Apache-2.0
"""The numbers and sentences of a check."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

from structgstream.pose_check.findings import Finding
from structgstream.preparation.checking.overlap import Coverage


@dataclass(frozen=True)
class PairCheck:
    """Matches of two pictures against the given poses.

    Args:
        first: name of a camera.
        second: name of another.
        matches: good matches, found without the poses; 0 where the cameras see too little in common.
        epipolar_pixels: their median distance to the epipolar lines of the poses; None without matches.
        share_violating: share of them that the poses cannot explain; None without matches.
    """

    first: str
    second: str
    matches: int
    epipolar_pixels: float | None
    share_violating: float | None


@dataclass(frozen=True)
class CameraCheck:
    """What was found of one camera.

    Args:
        reprojection_pixels: median distance of its keypoints to points that other cameras agree on; None without any.
        reprojection_pixels_90: their 90th percentile.
        points: number of these points.
        overlaps: number of cameras that it has matches with.
        exposure_stops: exposure relative to the median camera, as a power of two; None without matches.
        red_stops: red against green, relative to the median camera.
        blue_stops: blue against green, relative to the median camera.
        offset_ms: time against the other cameras, milliseconds; None where it was not estimated.
        offset_uncertainty_ms: its standard deviation.
        frames_lacking: number of the capture's frames that it has no picture of.
    """

    reprojection_pixels: float | None
    reprojection_pixels_90: float | None
    points: int
    overlaps: int
    exposure_stops: float | None = None
    red_stops: float | None = None
    blue_stops: float | None = None
    offset_ms: float | None = None
    offset_uncertainty_ms: float | None = None
    frames_lacking: int = 0


@dataclass(frozen=True)
class CheckReport:
    """The numbers of a check; ``as_json`` is what ``report.json`` holds.

    Args:
        capture: its name.
        frame: the frame that was looked at.
        cameras: by name, in the order of the rig.
        pairs: all pairs that were matched.
        coverage: of the points.
        findings: the worst first.
        rig_radius: in the capture's units.
        near: near plane, in the capture's units.
        nearest: depth that 0.5 % of the points fall below, in the capture's units; None without points.
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
    def errors(self) -> tuple[Finding, ...]:
        """The findings that spoil a stream."""
        return tuple(finding for finding in self.findings if finding.severity == "error")

    @property
    def median_epipolar_pixels(self) -> float | None:
        """Median over pairs, or None without matches."""
        known = sorted(pair.epipolar_pixels for pair in self.pairs if pair.epipolar_pixels is not None)
        return known[len(known) // 2] if known else None

    def as_json(self) -> dict[str, Any]:
        """Plain values, with the median over pairs."""
        return asdict(self) | {"median_epipolar_pixels": self.median_epipolar_pixels}
