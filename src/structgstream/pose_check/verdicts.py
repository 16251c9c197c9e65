# SPDX-License-Identifier: Apache-2.0
"""Which cameras are off, and by how much.

Those that disagree with others which agree with each other, compared with points of several cameras.
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from structgstream.cameras import Camera
from structgstream.data.matching import Pair
from structgstream.data.pair_matches import PairError
from structgstream.pose_check.resection import Resection, resect
from structgstream.pose_check.tracks import MIN_VIEWS, Evidence, Tracks, build_tracks, pair_errors, pixel_scale

TIMES_TYPICAL = 4.0
FLOOR_PIXELS = 0.75  # times pixel_scale
MAX_WEIGHT = 100  # matches above which a pair is not trusted more
OFF_SHARE = 0.5
VIOLATING_SHARE = 0.5
MIN_OUTLIER_POINTS, MIN_CAMERAS, OUTLIER_RATIO = 15, 4, 2.5
MIN_MATCHES = 60  # of a camera's pairs, from which on they count without points; chance makes 20 to 25


@dataclass(frozen=True)
class Suspects:
    """The verdict on a rig.

    Args:
        off: cameras that disagree with the others, the worst first.
        bad: pairs that the poses do not explain.
        limit_pixels: error above which a pair counts as such.
        everything: whether so much disagrees that no camera can be singled out.
    """

    off: tuple[str, ...]
    bad: tuple[Pair, ...]
    limit_pixels: float
    everything: bool

    @property
    def stray(self) -> tuple[Pair, ...]:
        """Bad pairs of cameras that fit others: most likely what is wrong there are the matches."""
        if self.everything:
            return ()
        return tuple(pair for pair in self.bad if not set(pair) & set(self.off))


def find_suspects(errors: Mapping[Pair, PairError], cameras: Mapping[str, Camera]) -> Suspects:
    """Names the cameras without which the poses explain the matches.

    A bumped camera has a large error with all cameras that see the same, while these agree with each other. So the
    camera whose matches are explained worst is taken away, until no camera has most of its matches unexplained. If
    fewer than half of the cameras remain, the mistake is not one of single cameras.
    """
    limit = _limit(errors, cameras)
    bad = {pair for pair, error in errors.items() if error.pixels > limit or error.share > VIOLATING_SHARE}
    weights = {pair: min(error.matches, MAX_WEIGHT) for pair, error in errors.items()}
    off: list[str] = []
    remaining = [name for name in cameras if any(name in pair for pair in errors)]
    while remaining:
        shares = {name: _share(name, bad, weights, off) for name in remaining}
        worst = max(remaining, key=lambda name: (shares[name], _amount(name, errors, off)))
        if shares[worst] < OFF_SHARE:
            break
        off.append(worst)
        remaining.remove(worst)
    seen = len(off) + len(remaining)
    everything = bool(off) and len(remaining) < max(2, (seen + 1) // 2)
    return Suspects(tuple(off), tuple(pair for pair in errors if pair in bad), limit, everything)


def track_outlier(tracks: Tracks, suspects: Suspects, *, cleared: Collection[str] = ()) -> str | None:
    """The camera, if any, whose observations lie farther from the points of the others than theirs, although its pairs
    look well.

    Along an epipolar line a match may lie anywhere: in a row of cameras, no pair reveals one that was turned along it.
    Points of several cameras do.

    Args:
        tracks: points of the cameras that are not off.
        suspects: the verdict so far.
        cleared: cameras that are not to be named.
    """
    medians = {}
    for name in tracks.names:
        seen = tracks.residuals[tracks.of(name) & (tracks.views[tracks.point] >= MIN_VIEWS)]
        if name not in suspects.off and len(seen) >= MIN_OUTLIER_POINTS:
            medians[name] = float(np.median(seen))
    if len(medians) < MIN_CAMERAS:
        return None
    named = [name for name in medians if name not in cleared]
    if not named:
        return None
    worst = max(named, key=lambda name: medians[name])
    others = float(np.median([median for name, median in medians.items() if name != worst]))
    return worst if medians[worst] > OUTLIER_RATIO * others else None


def _limit(errors: Mapping[Pair, PairError], cameras: Mapping[str, Camera]) -> float:
    """Pixels; relative to the better pairs, because soft pictures have large errors in any calibration."""
    width = max((camera.width for camera in cameras.values()), default=0)
    typical = float(np.percentile([error.pixels for error in errors.values()], 25)) if errors else 0.0
    floor = FLOOR_PIXELS * pixel_scale(width)
    return max(floor, min(TIMES_TYPICAL * typical, 4 * floor))


def _share(name: str, bad: Collection[Pair], weights: Mapping[Pair, int], off: Collection[str]) -> float:
    """Share of a camera's matches, with cameras that are not off, that lie in bad pairs."""
    own = {pair: weight for pair, weight in weights.items() if name in pair and not set(pair) & set(off)}
    total = sum(own.values())
    return sum(weight for pair, weight in own.items() if pair in bad) / total if total else 0.0


def _amount(name: str, errors: Mapping[Pair, PairError], off: Collection[str]) -> float:
    """Median error of a camera's pairs, to choose among cameras of equal shares."""
    own = [error.pixels for pair, error in errors.items() if name in pair and not set(pair) & set(off)]
    return float(np.median(own)) if own else 0.0


@dataclass(frozen=True)
class Verdict:
    """What is off, and by what evidence.

    Args:
        suspects: the cameras that are off.
        tracks: points of the others.
        resections: corrections of cameras that are off, where there are points for that.
        doubtful: cameras that matches contradict, but others fit.
        unchecked: cameras that so few matches contradict that chance may have made them.
    """

    suspects: Suspects
    tracks: Tracks
    resections: Mapping[str, Resection] = field(default_factory=dict)
    doubtful: tuple[str, ...] = ()
    unchecked: tuple[str, ...] = ()


def judge(evidence: Evidence, cameras: Mapping[str, Camera]) -> Verdict:
    """Names the cameras that are off.

    Pairs raise a suspicion; then points of the other cameras decide. A camera is off when another pose or focal length
    explains these points much better than the given one, and it is not when none explains more of them.

    Raises:
        MissingExtraError: cv2 or scipy is not installed.
    """
    errors = pair_errors(evidence, cameras)
    suspects = find_suspects(errors, cameras)
    if suspects.everything:
        return Verdict(suspects, build_tracks(evidence, cameras))
    tracks = build_tracks(evidence, cameras, off=suspects.off)
    resections = {name: resect(tracks, cameras[name], name) for name in suspects.off}
    off, doubtful, unchecked = [], [], []
    for name, found in resections.items():
        if found is not None and found.as_given:
            continue
        against, favouring = _matches(name, errors, suspects)
        if _is_off(found, suspects) or (against >= MIN_MATCHES and not favouring):
            off.append(name)
        elif against >= MIN_MATCHES:
            doubtful.append(name)
        elif against:
            unchecked.append(name)
    suspects = replace(suspects, off=tuple(off))
    found = {name: one for name in off if (one := resections[name]) is not None and one.better}
    return _with_track_outliers(evidence, cameras, Verdict(suspects, tracks, found, tuple(doubtful), tuple(unchecked)))


def _is_off(found: Resection | None, suspects: Suspects) -> bool:
    return found is not None and found.better and found.given_pixels > suspects.limit_pixels


def _matches(name: str, errors: Mapping[Pair, PairError], suspects: Suspects) -> tuple[int, int]:
    """Numbers of a camera's matches that lie in pairs against its pose and for it."""
    others = set(suspects.off) - {name}
    own = {pair: error.matches for pair, error in errors.items() if name in pair and not set(pair) & others}
    against = sum(matches for pair, matches in own.items() if pair in suspects.bad)
    return against, sum(own.values()) - against


def _with_track_outliers(evidence: Evidence, cameras: Mapping[str, Camera], verdict: Verdict) -> Verdict:
    """The verdict with cameras whose pairs look well, but which see points elsewhere than the others do."""
    suspects, resections, cleared = verdict.suspects, dict(verdict.resections), {*verdict.doubtful, *verdict.unchecked}
    tracks = build_tracks(evidence, cameras, off=suspects.off)
    while (name := track_outlier(tracks, suspects, cleared=cleared)) is not None:
        without = build_tracks(evidence, cameras, off=(*suspects.off, name))
        found = resect(without, cameras[name], name)
        if found is None or not _is_off(found, suspects):
            cleared.add(name)
            continue
        resections[name] = found
        suspects, tracks = replace(suspects, off=(*suspects.off, name)), without
    return replace(verdict, suspects=suspects, tracks=tracks, resections=resections)
