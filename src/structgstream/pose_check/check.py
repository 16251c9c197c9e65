# SPDX-License-Identifier: Apache-2.0
"""Checks the given poses against the pictures, before frame 0 is fitted and wherever a capture is checked: what is off,
and which mistake would explain it, in sentences (exchanged names, a pose of another convention, other units,
intrinsics of another picture size).

Inverted or flipped pose matrices are valid rigid motions, so only the pictures reveal them. Matches that were found
without the poses, and are inliers of some epipolar geometry, are tested against the epipolar geometry of the poses
(Hartley and Zisserman, Multiple View Geometry, chapter 11).

Note [Wrong matches]
~~~~~~~~~~~~~~~~~~~~
Wrong matches of repeated texture, or between cameras far apart, fit an epipolar geometry of their own: up to two thirds
of the matches of a pair contradict right poses (`examples/throw`, cameras 29 degrees apart). So a pair only raises a
suspicion: points that the other cameras agree on decide (`verdicts.judge`). Pairs of neighbours, which seldom match
wrongly, are tested first, and no others if all of these agree.
"""

import logging
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch

from structgstream.cameras import Camera, CameraRig
from structgstream.data.calibration import listed
from structgstream.data.matching import PAIR_SHARE, Pair, PairError, PairMatcher, neighbor_errors, pair_error
from structgstream.data.timeline import natural
from structgstream.errors import CalibrationError
from structgstream.frames import MultiViewFrame
from structgstream.pose_check.tracks import ALL_PAIRS, Evidence, gather, pair_errors, pixel_scale
from structgstream.pose_check.verdicts import Verdict, explained, find_suspects, judge

Severity = Literal["error", "warning", "note"]
SEVERITIES: tuple[Severity, ...] = ("error", "warning", "note")  # the worst first


@dataclass(frozen=True)
class Finding:
    """One thing that is wrong, or worth knowing, of some cameras.

    Args:
        severity: a stream made with an ``error`` is spoiled; a ``warning`` costs quality; a ``note`` is worth knowing.
        sentence: names camera or file, what was found and what to do.
    """

    severity: Severity
    sentence: str
    cameras: tuple[str, ...] = ()


def worst_first(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """The findings in the order of their severity."""
    return tuple(sorted(findings, key=lambda finding: SEVERITIES.index(finding.severity)))


EXPLAINED, UNEXPLAINED = 0.25, 0.5  # largest share of violating matches after, and smallest before
SLIGHT_PIXELS = 1.5  # times pixel_scale: blurs, but does not spoil
LENGTHS = {
    1000.0: "millimetres among metres",
    100.0: "centimetres among metres",
    0.001: "metres among millimetres",
    0.01: "metres among centimetres",
}
SIZES = (0.5, 2.0, 0.25, 4.0, 2 / 3, 1.5, 0.75, 4 / 3)


def _flipped(viewmat: torch.Tensor) -> torch.Tensor:
    return torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=viewmat.dtype)) @ viewmat


MISTAKES: Mapping[str, Callable[[torch.Tensor], torch.Tensor]] = {
    "inverted (camera to world in place of world to camera)": torch.linalg.inv,
    "in OpenGL axes in place of OpenCV's (y and z flipped)": _flipped,
    "inverted and in OpenGL axes (camera to world in place of world to camera)": lambda pose: _flipped(pose.inverse()),
}  # what undoes each


def readings_of(cameras: Mapping[str, Camera]) -> dict[str, dict[str, Camera]]:
    """The cameras after undoing each common mistake in all poses, by what the mistake is."""
    return {
        how: {name: replace(camera, viewmat=change(camera.viewmat)) for name, camera in cameras.items()}
        for how, change in MISTAKES.items()
    }


def explain(evidence: Evidence, cameras: Mapping[str, Camera], verdict: Verdict) -> list[Finding]:
    """A finding for each mistake that explains cameras, and for each camera that may be off or could not be checked."""
    suspects = verdict.suspects
    if suspects.everything:
        return [_explain_all(evidence, cameras)]
    findings, left = _exchanged(evidence, cameras, verdict)
    for name in left:
        sentence = _single(evidence, cameras, name, verdict) or _moved(evidence, cameras, name, verdict)
        found = verdict.resections.get(name)
        slight = found is not None and found.given_pixels < SLIGHT_PIXELS * pixel_scale(cameras[name].width)
        findings.append(Finding("warning" if slight else "error", sentence, (name,)))
    for name in verdict.doubtful:  # wrong matches, which may be what contradicts it
        sentence = (
            f"Camera {name!r} may be off: its matches with {_bad_pairs(evidence, cameras, name, verdict)} do not lie "
            "on the epipolar lines of its pose, but other matches do; wrong matches of repeated texture look like "
            "that, too: see in the report whether its dots lie where they should."
        )
        findings.append(Finding("warning", sentence, (name,)))
    for name in verdict.unchecked:  # too few matches to distinguish wrong ones from a wrong pose
        sentence = (
            f"The pose of camera {name!r} could not be checked: its few matches, with "
            f"{_bad_pairs(evidence, cameras, name, verdict)}, do not lie on the epipolar lines, as wrong matches do "
            "not either; move it closer to its neighbours, or add texture."
        )
        findings.append(Finding("note", sentence, (name,)))
    return findings


def _explain_all(evidence: Evidence, cameras: Mapping[str, Camera]) -> Finding:
    """Most pairs disagree: a convention that all poses share, else nothing single."""
    pairs = evidence.overlapping()
    before = _shares(evidence, cameras, pairs)
    readings = {how: _shares(evidence, reading, pairs) for how, reading in readings_of(cameras).items()}
    best = min(readings, key=lambda how: readings[how])
    if readings[best] < min(0.5, before / 2):
        sentence = (
            f"The poses of all cameras look {best}: {before:.0%} of the matches between pictures violate them as "
            f"they are, {readings[best]:.0%} once that is undone; write world-to-camera matrices with OpenCV axes."
        )
    else:
        sentence = (
            f"Poses and pictures do not belong together: {before:.0%} of the matches between pictures violate the "
            "poses of most cameras; check that names, pictures and calibration are of one take and of one picture "
            "size, that the cameras are in step, or calibrate again with structgstream prepare."
        )
    return Finding("error", sentence, tuple(cameras))


def _exchanged(evidence: Evidence, cameras: Mapping[str, Camera], verdict: Verdict) -> tuple[list[Finding], list[str]]:
    """Cameras that are off and agree with the others under each other's calibration, and those that are left."""
    off = verdict.suspects.off
    if len(off) < 2:
        return [], list(off)
    sizes = {name: (cameras[name].width, cameras[name].height) for name in off}
    usual = max(sizes.values(), key=[*sizes.values()].count)
    same = sorted((name for name in off if sizes[name] == usual), key=natural)
    from scipy.optimize import linear_sum_assignment

    costs = np.array(
        [[_share_with(evidence, cameras, name, cameras[other], verdict) for other in same] for name in same]
    )
    rows, columns = linear_sum_assignment(np.nan_to_num(costs, nan=1.0))
    moved = [
        (same[row], same[column])
        for row, column in zip(rows, columns, strict=True)
        if row != column and costs[row, column] < EXPLAINED and costs[row, row] > UNEXPLAINED
    ]
    names = [name for name, _ in moved]
    if not moved or set(names) != {other for _, other in moved}:
        return [], list(off)
    if len(moved) == 2:
        sentence = f"The names of cameras {names[0]!r} and {names[1]!r} are exchanged"
    else:
        sentence = "Names of cameras are exchanged: " + ", ".join(
            f"the pictures of {name!r} belong to the calibration of {other!r}" for name, other in moved
        )
    worst = max(costs[same.index(name), same.index(other)] for name, other in moved)
    sentence += f": put right, {1 - worst:.0%} of their matches or more fit; rename files or the calibration's cameras."
    return [Finding("error", sentence, tuple(names))], [name for name in off if name not in names]


def _single(evidence: Evidence, cameras: Mapping[str, Camera], name: str, verdict: Verdict) -> str | None:
    """A mistake of one camera that explains it."""
    own = cameras[name]
    before = _share_with(evidence, cameras, name, own, verdict)
    if not before > UNEXPLAINED:
        return None
    changed = {
        f"has its pose {how}; write it as world to camera with OpenCV axes": undone[name]
        for how, undone in readings_of({name: own}).items()
    }
    for factor, unit in LENGTHS.items():
        viewmat = own.viewmat.clone()
        viewmat[:3, 3] *= 1 / factor
        changed[
            f"stands {factor:g} times as far from the origin as its pictures say: its position looks like {unit}; "
            "write it in the unit of the others"
        ] = replace(own, viewmat=viewmat)
    for factor in SIZES:
        scale = torch.tensor([[factor], [factor], [1.0]], dtype=torch.float64)
        changed[
            f"has intrinsics of a picture of {own.width / factor:.0f}x{own.height / factor:.0f} pixels, its pictures "
            f"have {own.width}x{own.height}; scale them by {factor:g}"
        ] = replace(own, K=own.K * scale)
    shares = {sentence: _share_with(evidence, cameras, name, camera, verdict) for sentence, camera in changed.items()}
    sentence = min(shares, key=lambda sentence: shares[sentence])
    return f"Camera {name!r} {sentence}." if shares[sentence] < EXPLAINED else None


def _moved(evidence: Evidence, cameras: Mapping[str, Camera], name: str, verdict: Verdict) -> str:
    """How far a camera is from the pose of its pictures, as far as they determine it."""
    if (found := verdict.resections.get(name)) is not None:
        sentence = (
            f"Camera {name!r} is off: {found.points} points that other cameras agree on lie {found.given_pixels:.1f} "
            "pixels (median) from where its picture shows them"
        )
        sentence += f"; its pictures {found.description}" if found.description else ""
    else:
        sentence = (
            f"Camera {name!r} is off: its matches with {_bad_pairs(evidence, cameras, name, verdict)}, which agree "
            "with each other, do not lie on the epipolar lines of its pose"
        )
    return sentence + ". It was bumped or its calibration is another's: calibrate again, or leave it out."


def _bad_pairs(evidence: Evidence, cameras: Mapping[str, Camera], name: str, verdict: Verdict) -> str:
    """Names, with errors in pixels, of the cameras whose matches a camera's pose does not explain."""
    bad = []
    for pair in verdict.suspects.bad:
        if name in pair and not set(pair) & set(verdict.suspects.off) - {name}:
            (other,) = set(pair) - {name}
            error = pair_error(cameras[pair[0]], cameras[pair[1]], *evidence.pixels(pair))
            bad.append(f"{other!r} ({error.matches}, off by {error.pixels:.1f} pixels)")
    return ", ".join(bad[:4]) + (f" and {len(bad) - 4} more" if len(bad) > 4 else "")


def _share_with(
    evidence: Evidence, cameras: Mapping[str, Camera], name: str, camera: Camera, verdict: Verdict
) -> float:
    """Share of the evidence that contradicts ``camera`` in place of camera ``name``; NaN without evidence.

    The evidence are the points that the corrected camera explains or, without a correction, the matches with cameras
    that are not off.
    """
    if (found := verdict.resections.get(name)) is not None:
        return max(1 - explained(verdict.tracks, camera, name) / found.points, 0.0)
    good = set(cameras) - set(verdict.suspects.off)
    pairs = [pair for pair in evidence.overlapping() if name in pair and (set(pair) - {name}) <= good]
    return _shares(evidence, {**cameras, name: camera}, pairs)


def _shares(evidence: Evidence, cameras: Mapping[str, Camera], pairs: Sequence[Pair]) -> float:
    return _violating([pair_error(cameras[pair[0]], cameras[pair[1]], *evidence.pixels(pair)) for pair in pairs])


def _violating(errors: Collection[PairError]) -> float:
    """Share of the matches of all pairs that violate the poses; NaN without any."""
    total = sum(error.matches for error in errors)
    return sum(error.share * error.matches for error in errors) / total if total else float("nan")


MIN_MATCHES = 100  # of a rig, for a verdict
CONTRADICTED_SHARE = 0.5  # of the matches, above which poses are refused if most cameras are off

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class PoseCheck:
    """Result of the pose check."""

    matches: int  # number of good matches
    share_violating: float  # share of these that violate the poses; nan without matches
    unmatched: tuple[str, ...]  # cameras without a match to any other that was tried

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

    Suspicious cameras are reported by warnings; poses that the pictures contradict as a whole are refused.

    Raises:
        CalibrationError: most cameras are off, and most good matches violate the epipolar geometry of the poses.
    """
    cameras = {name: rig[name] for name in frame.showing(rig.training)}
    matcher = PairMatcher(frame.images, masks=frame.masks)
    near = {pair: error for pair, error in neighbor_errors(cameras, matcher).items() if error is not None}
    check = _summed(near, cameras)
    contradicted = find_suspects(near, cameras).bad or any(error.share > PAIR_SHARE for error in near.values())
    if check.conclusive and not check.unmatched and not contradicted:
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
    return check


def _summed(errors: Mapping[Pair, PairError], cameras: Mapping[str, Camera]) -> PoseCheck:
    """The numbers of all pairs."""
    matched = {name for pair in errors for name in pair}
    unmatched = tuple(name for name in cameras if name not in matched)
    return PoseCheck(sum(error.matches for error in errors.values()), _violating(errors.values()), unmatched)
