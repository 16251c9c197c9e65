# SPDX-License-Identifier: Apache-2.0
"""Which cameras see the same things, how much of the scene, and whether lengths fit together."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np

from structgstream.cameras import Camera
from structgstream.data.calibration import listed
from structgstream.data.matching import Pair, connected_groups, inside, project
from structgstream.geometry import Floats, Indices
from structgstream.pose_check.check import Finding
from structgstream.pose_check.tracks import MIN_VIEWS, Tracks

MIN_OVERLAPS = 2


@dataclass(frozen=True)
class Coverage:
    """How much of the scene how many cameras see."""

    points: int  # number of points that were triangulated
    seen_by_three: float  # share of them that at least three cameras see
    median_cameras: float  # median number of cameras that see a point


def cameras_per_point(points: Floats, cameras: Mapping[str, Camera]) -> Indices:
    """Number ``[P]`` of cameras whose picture contains each point, occluded or not."""
    count = np.zeros(len(points), np.intp)
    for camera in cameras.values():
        count += inside(camera, *project(camera, points), near=0.0)
    return count


def coverage(points: Floats, cameras: Mapping[str, Camera]) -> Coverage:
    """How many cameras see the points."""
    if not len(points):
        return Coverage(0, 0.0, 0.0)
    seen = cameras_per_point(points, cameras)
    return Coverage(len(points), float((seen >= 3).mean()), float(np.median(seen)))


def overlaps(pairs: Collection[Pair], names: Collection[str]) -> dict[str, int]:
    """Number of cameras that each has matches with."""
    return {name: sum(name in pair for pair in pairs) for name in names}


def overlap_findings(pairs: Collection[Pair], names: Collection[str]) -> list[Finding]:
    """Cameras that see too little in common with others.

    Warnings where no camera has matches, the cameras fall apart into groups, or one has few overlaps.
    """
    if not pairs:
        sentence = (
            f"No two of the {len(names)} cameras have enough matches to check their poses: too little overlap or "
            "texture; look at the pictures of the report, and move the cameras closer together or add texture."
        )
        return [Finding("warning", sentence, tuple(names))]
    findings = []
    whole, *others = connected_groups(names, pairs)
    single = [group[0] for group in others if len(group) == 1]
    for group in ([single] if single else []) + [group for group in others if len(group) > 1]:
        sentence = (
            f"The pictures of {listed(group)} have no matches with those of the others, so their poses are not "
            "checked; black, blurred and mirrored ones match nothing, so look at them in the report. Else move the "
            "cameras closer to the others, or film a calibration board there."
        )
        findings.append(Finding("warning", sentence, tuple(group)))
    for name, count in overlaps(pairs, names).items():
        if name in whole and count < MIN_OVERLAPS <= len(names) - 1:
            sentence = (
                f"Camera {name!r} has matches with {count} other camera only; what it alone sees has no depth: "
                "move it closer to its neighbours."
            )
            findings.append(Finding("warning", sentence, (name,)))
    return findings


NEAR_PERCENTILE = 0.5
MIN_POINTS = 30
CUT_SHARE = 0.02
CLOSEST_NEAR = 0.0007  # of the depth of the nearest points: a near plane any closer looks like one in another unit
PLAUSIBLE_METRES = (0.03, 60.0)  # of a rig's radius: a desk, a stadium's corner
UNITS = {1000.0: "1000 times too small (metres among millimetres)", 0.001: "1000 times too large (millimetres among "
         "metres)", 100.0: "100 times too small (metres among centimetres)", 0.01: "100 times too large (centimetres "
         "among metres)"}  # fmt: skip
FIT = 0.5
MIN_EXTENT = 0.03  # of the points that a rig sees, as a share of their depth


def observed_depths(tracks: Tracks, cameras: Mapping[str, Camera], *, off: Collection[str] = ()) -> Floats:
    """Depths of points in the cameras, of those not ``off``, that observed them; of three cameras, or else of two."""
    views = tracks.views
    min_views = MIN_VIEWS if (views >= MIN_VIEWS).sum() >= MIN_POINTS else 2
    depths = []
    for number, name in enumerate(tracks.names):
        if name in off:
            continue
        rows = (tracks.camera == number) & (views[tracks.point] >= min_views) & np.isfinite(tracks.residuals)
        depths.append(project(cameras[name], tracks.points[tracks.point[rows]])[1])
    return np.concatenate(depths) if depths else np.empty(0)


def nearest_depth(depths: Floats) -> float | None:
    """The depth that only few points fall below; None when there are too few."""
    depths = depths[depths > 0]
    return float(np.percentile(depths, NEAR_PERCENTILE)) if len(depths) >= MIN_POINTS else None


def scale_findings(
    depths: Floats, points: Floats | None, cameras: Mapping[str, Camera], *, radius: float, unit: str | None
) -> list[Finding]:
    """What contradicts in lengths, which are in ``unit`` where the capture states it.

    ``depths`` are of points that the pictures confirm (:func:`observed_depths`), ``points`` ``[P, 3]`` came with the
    capture.
    """
    findings = []
    near = float(np.median([camera.near for camera in cameras.values()]))
    depths = depths[depths > 0]
    if len(depths) >= MIN_POINTS and (cut := float((depths < near).mean())) > CUT_SHARE:
        typical = float(np.median(depths))
        hint = "; poses and near plane look like different units of length" if near > 50 * typical else ""
        nearest = np.percentile(depths, NEAR_PERCENTILE)
        sentence = (
            f"The near plane lies at {near:.4g}, beyond {cut:.0%} of the points, whose nearest are at {nearest:.4g} "
            f"and whose median is at {typical:.4g}{hint}; set --near {0.5 * nearest:.3g}."
        )
        findings.append(Finding("error", sentence))
    elif (nearest := nearest_depth(depths)) is not None and near < CLOSEST_NEAR * nearest:
        sentence = (
            f"The near plane lies at {near:.4g}, and the nearest points at {nearest:.4g}: poses and near plane look "
            "like different units of length, as of positions in millimetres and a near plane in metres; convert one of "
            f"them, or set --near {0.5 * nearest:.3g}."
        )
        findings.append(Finding("warning", sentence))
    if unit == "metres" and not PLAUSIBLE_METRES[0] <= radius <= PLAUSIBLE_METRES[1]:
        like = "millimetres or centimetres" if radius > 1 else "kilometres"
        sentence = (
            f"The cameras stand up to {radius:.4g} from their middle, and the capture says metres: the positions look "
            f"like {like}; convert them, or give a distance between two cameras."
        )
        findings.append(Finding("error", sentence))
    if points is not None and len(points) >= MIN_POINTS and (sentence := _foreign_points(points, depths, cameras)):
        findings.append(Finding("error", sentence))
    return findings


def _foreign_points(points: Floats, depths: Floats, cameras: Mapping[str, Camera]) -> str | None:
    """A sentence when the points that came along are not of these cameras."""
    fits = float((cameras_per_point(points, cameras) >= 2).mean())
    if len(depths) < MIN_POINTS:
        return None
    typical = float(np.median(depths))
    if fits >= FIT and 0.02 < _typical_depth(points, cameras) / typical < 50:
        return None
    extent = float(np.median(np.linalg.norm(points - np.median(points, axis=0), axis=1)))
    differences = {
        factor: abs(np.log(_typical_depth(points * factor, cameras) / typical))
        for factor in UNITS
        if factor * extent > MIN_EXTENT * typical  # any points, made small enough, lie in the middle of a rig
    }
    likely = min(differences, key=lambda factor: differences[factor], default=None)
    if likely is not None and differences[likely] < np.log(5):
        return (
            f"The points that come with the capture lie at impossible depths: they look {UNITS[likely]}; convert "
            "points and positions of cameras to one unit, or leave the points out."
        )
    return (
        f"Only {fits:.0%} of the points that come with the capture lie where two cameras see them: they are of other "
        "cameras; leave them out, or prepare the capture again."
    )


def _typical_depth(points: Floats, cameras: Mapping[str, Camera]) -> float:
    return max(float(np.median([np.abs(project(camera, points)[1]) for camera in cameras.values()])), 1e-12)
