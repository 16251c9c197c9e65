# SPDX-License-Identifier: Apache-2.0
"""Checks the given poses against the pictures.

Inverted or flipped pose matrices are valid rigid motions, so only the pictures reveal them. Matches that were found
without the poses, and are inliers of some epipolar geometry, are tested against the epipolar geometry of the poses
(Hartley and Zisserman, Multiple View Geometry, chapter 11).
"""

import logging
from collections import Counter
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from structgstream.cameras import Camera, CameraRig
from structgstream.data.arrays import Floats
from structgstream.data.calibration import listed
from structgstream.data.matching import (
    Pair,
    angles,
    epipolar_errors,
    fundamental_matrix,
    neighbor_views,
    rays,
    triangulate,
    unique_pairs,
    viewing_distance,
)
from structgstream.data.pair_matches import MatchConfig, PairMatcher
from structgstream.data.timeline import natural
from structgstream.errors import CalibrationError
from structgstream.frames import MultiViewFrame

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class PoseCheckConfig:
    """Thresholds of the pose check.

    Args:
        matches: how matches are found.
        pairs: most pairs of neighbours tested: all of rigs up to 150 cameras, since a camera of which no pair is tested
            is not checked.
        neighbors: of each camera, in pairs.
        more_neighbors: of cameras that look suspicious.
        violation_share: distance to the epipolar line of the poses, as a share of the picture's width, above which a
            match violates them; a match triangulated behind a camera violates them too.
        min_parallax_degrees: smallest angle between the rays at which a point behind a camera counts.
        max_share: poses are rejected if a larger share of the good matches violates them.
        min_matches: least number of good matches for a verdict.
        pair_share: a pair contradicts the poses if a larger share of its matches violates them: of
            right poses 0 to 0.14, of exchanged ones most.
        max_suspects: poses are rejected if a larger share of the cameras is suspicious.
    """

    matches: MatchConfig = MatchConfig()
    pairs: int = 200
    neighbors: int = 2
    more_neighbors: int = 4
    violation_share: float = 0.01
    min_parallax_degrees: float = 0.3
    max_share: float = 0.6
    min_matches: int = 100
    pair_share: float = 0.3
    max_suspects: float = 0.5


@dataclass(frozen=True)
class PoseCheck:
    """Result of the pose check.

    Args:
        median_epipolar_error_pixels: median distance to the epipolar line of the poses; nan without matches.
        share_violating: share of the good matches that violate the poses; nan without matches.
        matches: number of good matches.
        pairs: number of pairs of cameras they come from.
        conclusive: whether ``min_matches`` is reached.
        suspects: cameras without which no pair contradicts the poses; empty where all is right.
        unmatched: cameras without a match to any neighbour, as neighbours by wrong poses see other things.
    """

    median_epipolar_error_pixels: float
    share_violating: float
    matches: int
    pairs: int
    conclusive: bool
    suspects: tuple[str, ...] = ()
    unmatched: tuple[str, ...] = ()


def check_poses(frame: MultiViewFrame, rig: CameraRig, *, config: PoseCheckConfig = PoseCheckConfig()) -> PoseCheck:
    """Test matches of neighbouring training cameras against the given poses; held-out pictures are never read.

    Poses are right, or suspicious, which a warning reports with the cameras, or contradicted by the pictures.

    Raises:
        CalibrationError: most good matches violate the epipolar geometry of the poses, or those of most cameras do.
        MissingExtraError: cv2 is not installed.
    """
    given = {name: rig[name] for name in frame.showing(rig.training)}
    matcher = PairMatcher(frame.images, config.matches, masks=frame.masks)
    check = _judge(given, matcher.matches(_pairs(given, config)), config)
    doubted = check.suspects or check.unmatched
    if check.conclusive and not doubted:
        return check
    if check.conclusive and not _contradicted(check, len(given), config):
        wider = replace(config, neighbors=config.more_neighbors)
        more = [pair for pair in _pairs(given, wider) if {*doubted}.intersection(pair)]
        check = _judge(given, matcher.matches([*dict.fromkeys([*_pairs(given, config), *more])]), config)
        if not _contradicted(check, len(given), config):
            _warn(check, len(given))
            return check
    # Pairs chosen by wrong poses hardly match, so pairs chosen after undoing each common mistake are tested too.
    readings = {name: reinterpreted(given, change) for name, change in MISTAKES.items()}
    pairs = dict.fromkeys(pair for cameras in (given, *readings.values()) for pair in _pairs(cameras, config))
    matches = matcher.matches(list(pairs))
    check = _judge(given, matches, config)
    if not check.conclusive:
        _log.warning("Too few good matches (%d) to check the camera poses against the pictures.", check.matches)
        return check
    if not _contradicted(check, len(given), config):
        _warn(check, len(given))
        return check
    shares = {name: _judge(cameras, matches, config).share_violating for name, cameras in readings.items()}
    likely = min(shares, key=lambda name: shares[name])
    if shares[likely] < min(0.5, check.share_violating / 2):
        advice = f"{1 - shares[likely]:.0%} fit once {likely}."
    else:
        advice = (
            "Expected world-to-camera matrices with OpenCV axes (x right, y down, z forward), intrinsics in "
            "pixels of these pictures, and each camera's own pictures, in sync: check these."
        )
    raise CalibrationError(
        f"{check.share_violating:.0%} of {check.matches} good matches between neighbouring cameras violate "
        "the epipolar geometry of the given poses (median distance "
        f"{check.median_epipolar_error_pixels:.1f} pixels). {advice}"
    )


def _contradicted(check: PoseCheck, cameras: int, config: PoseCheckConfig) -> bool:
    doubted = len({*check.suspects, *check.unmatched}) if check.suspects else 0
    return check.share_violating > config.max_share or doubted > config.max_suspects * cameras


def _warn(check: PoseCheck, cameras: int) -> None:
    if check.suspects:
        _log.warning(
            "The poses or names of %s of %d look wrong: their pictures contradict the other cameras' (%.0f%% of %d "
            "matches). Correct them, or leave these cameras out; structgstream prepare --check says more.",
            listed(check.suspects, most=12), cameras, 100 * check.share_violating, check.matches,
        )  # fmt: skip
    if check.unmatched:
        _log.warning(
            "The pictures of %s of %d match those of no neighbour, so their poses and names are not confirmed; look at "
            "structgstream prepare --check.",
            listed(check.unmatched, most=12), cameras,
        )  # fmt: skip


def confirmed_share(cameras: Mapping[str, Camera], matcher: PairMatcher, config: PoseCheckConfig) -> float:
    """The share of the pairs of neighbours whose pictures match and agree with the poses, to compare readings."""
    verdicts = _verdicts(cameras, matcher.matches(_pairs(cameras, config)), config)
    agree = [total > 0 and violating <= config.pair_share * total for total, violating, _ in verdicts.values()]
    return sum(agree) / max(1, len(agree))


def _inverted(viewmat: Tensor) -> Tensor:
    return torch.linalg.inv(viewmat)


def _flipped(viewmat: Tensor) -> Tensor:
    return torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=viewmat.dtype)) @ viewmat


MISTAKES: Mapping[str, Callable[[Tensor], Tensor]] = {
    "every pose is inverted: they look like camera-to-world matrices given as world-to-camera; invert them": _inverted,
    "the y and z axes of every camera are flipped: they look like OpenGL axes; expected OpenCV ones": _flipped,
    "every pose is inverted and its y and z axes flipped: they look like camera-to-world matrices with "
    "OpenGL axes; expected world-to-camera with OpenCV axes": lambda viewmat: _flipped(_inverted(viewmat)),
}


def reinterpreted(cameras: Mapping[str, Camera], change: Callable[[Tensor], Tensor]) -> dict[str, Camera]:
    """The cameras with their view matrices changed."""
    return {name: replace(camera, viewmat=change(camera.viewmat)) for name, camera in cameras.items()}


def _pairs(cameras: Mapping[str, Camera], config: PoseCheckConfig) -> list[Pair]:
    """Pairs of neighbours, spread over the rig."""
    pairs = unique_pairs(neighbor_views(cameras, count=config.neighbors, distance=viewing_distance(cameras)))
    chosen = np.linspace(0, len(pairs) - 1, min(len(pairs), config.pairs)).round().astype(int)
    return [pairs[index] for index in chosen]


class _Verdict(NamedTuple):
    """Of a pair: how many matches it has, how many violate the poses, and their distances in pixels ``[S]``."""

    total: int
    violating: int
    errors: Floats


def _verdicts(
    cameras: Mapping[str, Camera], matches: Mapping[Pair, tuple[Floats, Floats]], config: PoseCheckConfig
) -> dict[Pair, _Verdict]:
    verdicts = {}
    for (first, second), (pixels1, pixels2) in matches.items():
        if len(pixels1) == 0:
            verdicts[first, second] = _Verdict(0, 0, np.empty(0))
            continue
        pair = cameras[first], cameras[second]
        error = epipolar_errors(fundamental_matrix(*pair), pixels1, pixels2)
        # Cameras that only differ in position keep their epipolar lines when inverted, but look backwards.
        _, depths = triangulate(*pair, pixels1, pixels2)
        parallax = np.degrees(angles(rays(pair[0], pixels1), rays(pair[1], pixels2)))
        behind = (depths < 0).any(1) & (parallax > config.min_parallax_degrees)
        violating = int(((error > config.violation_share * pair[0].width) | behind).sum())
        verdicts[first, second] = _Verdict(len(error), violating, error)
    return verdicts


def _judge(
    cameras: Mapping[str, Camera], matches: Mapping[Pair, tuple[Floats, Floats]], config: PoseCheckConfig
) -> PoseCheck:
    verdicts = _verdicts(cameras, matches, config)
    total = sum(verdict.total for verdict in verdicts.values())
    if total == 0:
        return PoseCheck(float("nan"), float("nan"), 0, 0, False)
    judged = {pair: verdict for pair, verdict in verdicts.items() if verdict.total}
    bad = {pair for pair, verdict in judged.items() if verdict.violating > config.pair_share * verdict.total}
    matched = {name for pair in judged for name in pair}
    unmatched = {name for pair in verdicts for name in pair} - matched
    return PoseCheck(
        float(np.median(np.concatenate([verdict.errors for verdict in judged.values()]))),
        sum(verdict.violating for verdict in judged.values()) / total,
        total,
        len(judged),
        total >= config.min_matches,
        _suspects(bad, judged),
        tuple(sorted(unmatched, key=natural)),
    )


def _suspects(bad: Collection[Pair], judged: Collection[Pair]) -> tuple[str, ...]:
    """The fewest cameras that explain the pairs that contradict the poses: greedily those with most of their pairs."""
    found, left = list[str](), set(bad)
    while left:
        wrong = Counter(name for pair in left for name in pair)
        among = Counter(name for pair in judged if not set(found).intersection(pair) for name in pair)
        worst = max(sorted(wrong), key=lambda name: (wrong[name] / among[name], wrong[name]))
        found.append(worst)
        left = {pair for pair in left if worst not in pair}
    return tuple(sorted(found, key=natural))
