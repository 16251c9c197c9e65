# SPDX-License-Identifier: Apache-2.0
"""Checks the given poses against the pictures, before frame 0 is fitted and wherever a capture is checked.

Inverted or flipped pose matrices are valid rigid motions, so only the pictures reveal them. Matches that were found
without the poses, and are inliers of some epipolar geometry, are tested against the epipolar geometry of the poses
(Hartley and Zisserman, Multiple View Geometry, chapter 11).

Note [Wrong matches]
~~~~~~~~~~~~~~~~~~~~
Of repeated texture, or between cameras far apart, wrong matches fit an epipolar geometry of their own, and a pair of
right poses is contradicted by up to two thirds of its matches (`examples/throw`, cameras 29 degrees apart). So a pair
only raises a suspicion: points that the other cameras agree on decide (`verdicts.judge`). Pairs of neighbours, which
seldom match wrongly, are looked at first, and no others where all of them agree.
"""

import logging
from collections.abc import Mapping
from dataclasses import dataclass

from structgstream.cameras import Camera, CameraRig
from structgstream.data.calibration import listed
from structgstream.data.matching import PAIR_SHARE, PairError, PairMatcher, neighbor_errors
from structgstream.errors import CalibrationError
from structgstream.frames import MultiViewFrame
from structgstream.pose_check.findings import Finding, explain, readings_of
from structgstream.pose_check.tracks import ALL_PAIRS, Evidence, gather, pair_errors
from structgstream.pose_check.verdicts import Verdict, find_suspects, judge

MIN_MATCHES = 100  # of a rig, for a verdict
CONTRADICTED_SHARE = 0.5  # of the matches, above which poses are refused if most cameras are off

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class PoseCheck:
    """Result of the pose check."""

    matches: int  # number of good matches
    share_violating: float  # share of these that violate the poses; nan without matches
    off: tuple[str, ...] = ()  # cameras that are off; empty where all is right
    unmatched: tuple[str, ...] = ()  # cameras without a match to any other that was tried
    findings: tuple[Finding, ...] = ()  # what is off, in sentences

    @property
    def conclusive(self) -> bool:
        """Whether there are enough matches for a verdict."""
        return self.matches >= MIN_MATCHES


def examine_poses(
    frame: MultiViewFrame, cameras: Mapping[str, Camera], *, matcher: PairMatcher | None = None
) -> tuple[Evidence, Verdict]:
    """Matches of one instant's pictures, and which cameras are off by them."""
    evidence = gather(frame, cameras, matcher=matcher)
    verdict = judge(evidence, cameras)
    matches = sum(map(len, evidence.matches.values()))
    if len(cameras) > ALL_PAIRS and (verdict.suspects.everything or matches < MIN_MATCHES):
        # Neighbours by wrong poses hardly match: those by the poses after undoing each common mistake may.
        evidence = gather(frame, cameras, matcher=matcher, readings=readings_of(cameras).values())
        verdict = judge(evidence, cameras)
    return evidence, verdict


def check_poses(frame: MultiViewFrame, rig: CameraRig) -> PoseCheck:
    """Test the given poses of the training cameras; held-out pictures are never read.

    Poses are right, or suspicious, which warnings report with the cameras, or contradicted by the pictures.

    Raises:
        CalibrationError: most cameras are off, and most good matches violate the epipolar geometry of the poses.
    """
    cameras = {name: rig[name] for name in frame.showing(rig.training)}
    matcher = PairMatcher(frame.images, masks=frame.masks)
    near = neighbor_errors(cameras, matcher)
    check = _summed({pair: error for pair, error in near.items() if error is not None}, cameras)
    if check.conclusive and not check.unmatched and not _contradicted(near, cameras):
        return check
    evidence, verdict = examine_poses(frame, cameras, matcher=matcher)
    check = _summed(pair_errors(evidence, cameras), cameras)
    if not check.conclusive:
        _log.warning("Too few good matches (%d) to check the camera poses against the pictures.", check.matches)
        return check
    findings = explain(evidence, cameras, verdict)
    if verdict.suspects.everything and check.share_violating > CONTRADICTED_SHARE:
        raise CalibrationError(findings[0].sentence)
    for finding in findings:
        _log.log(logging.INFO if finding.severity == "note" else logging.WARNING, "%s", finding.sentence)
    if check.unmatched:
        _log.warning(
            "The pictures of %s of %d match those of no other camera, so their poses and names are not confirmed; look "
            "at structgstream prepare --check.",
            listed(check.unmatched, limit=12), len(cameras),
        )  # fmt: skip
    off = tuple(cameras) if verdict.suspects.everything else verdict.suspects.off
    return PoseCheck(check.matches, check.share_violating, off, check.unmatched, tuple(findings))


def _contradicted(errors: Mapping[tuple[str, str], PairError | None], cameras: Mapping[str, Camera]) -> bool:
    """Whether a pair of neighbours contradicts the poses."""
    found = {pair: error for pair, error in errors.items() if error is not None}
    return bool(find_suspects(found, cameras).bad) or any(error.share > PAIR_SHARE for error in found.values())


def _summed(errors: Mapping[tuple[str, str], PairError], cameras: Mapping[str, Camera]) -> PoseCheck:
    """The numbers of all pairs."""
    total = sum(error.matches for error in errors.values())
    violating = sum(error.matches * error.share for error in errors.values())
    matched = {name for pair in errors for name in pair}
    unmatched = tuple(name for name in cameras if name not in matched)
    return PoseCheck(total, violating / total if total else float("nan"), unmatched=unmatched)
