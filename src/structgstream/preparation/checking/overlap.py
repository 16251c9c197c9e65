# SPDX-License-Identifier: Apache-2.0
"""Which cameras see the same things, and how much of the scene how many of them see."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from structgstream.cameras import Camera
from structgstream.data.arrays import Floats
from structgstream.data.calibration import listed
from structgstream.data.matching import Pair, connected_groups, inside, project
from structgstream.pose_check.findings import Finding

MIN_OVERLAPS = 2


@dataclass(frozen=True)
class Coverage:
    """How much of the scene how many cameras see.

    Args:
        points: number of points that were triangulated.
        seen_by_three: share of them that at least three cameras see.
        median_cameras: median number of cameras that see a point.
    """

    points: int
    seen_by_three: float
    median_cameras: float


def cameras_per_point(points: Floats, cameras: Mapping[str, Camera]) -> NDArray[np.intp]:
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

    An error when no camera has matches; warnings where the cameras fall apart into groups, or one has few overlaps.
    """
    if not pairs:
        return [
            Finding(
                "warning",
                f"No two of the {len(names)} cameras have enough matches to check their poses: too little overlap or "
                "texture; look at the pictures of the report, and move the cameras closer together or add texture.",
                tuple(names),
            )
        ]
    findings = []
    whole, *others = connected_groups(names, pairs)
    single = [group[0] for group in others if len(group) == 1]
    for group in ([single] if single else []) + [group for group in others if len(group) > 1]:
        findings.append(
            Finding(
                "warning",
                f"The pictures of {listed(group)} have no matches with those of the others, so their poses are not "
                "checked; move them closer to the others, or film a calibration board there.",
                tuple(group),
            )
        )
    for name, count in overlaps(pairs, names).items():
        if name in whole and count < MIN_OVERLAPS <= len(names) - 1:
            findings.append(
                Finding(
                    "warning",
                    f"Camera {name!r} has matches with {count} other camera only; what it alone sees has no depth: "
                    "move it closer to its neighbours.",
                    (name,),
                )
            )
    return findings
