# SPDX-License-Identifier: Apache-2.0
"""Which cameras are off, and by how much: what pairs say, held against points of several cameras."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from structgstream.cameras import Camera
from structgstream.data.matching import Pair
from structgstream.data.pair_matches import PairError
from structgstream.pose_check.evidence import Evidence, pair_errors
from structgstream.pose_check.resection import Resection, resected
from structgstream.pose_check.suspects import Suspects, accused, find_suspects
from structgstream.pose_check.tracks import Tracks, build_tracks

LEAST_MATCHES = 60  # of a camera's pairs, from which on they tell something without points; chance makes 20 to 25


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

    Pairs accuse; then points of the other cameras decide. A camera is off when another pose or focal length explains
    these points much better than the given one, and it is not when none explains more of them.

    Raises:
        MissingExtraError: cv2 or scipy is not installed.
    """
    errors = pair_errors(evidence, cameras)
    suspects = find_suspects(errors, cameras)
    if suspects.everything:
        return Verdict(suspects, build_tracks(evidence, cameras))
    tracks = build_tracks(evidence, cameras, off=suspects.off)
    resections = {name: resected(tracks, cameras[name], name) for name in suspects.off}
    off, doubtful, unchecked = [], [], []
    for name, found in resections.items():
        if found is not None and found.as_given:
            continue
        against, favouring = _matches(name, errors, suspects)
        if _is_off(found, suspects) or (against >= LEAST_MATCHES and not favouring):
            off.append(name)
        elif against >= LEAST_MATCHES:
            doubtful.append(name)
        elif against:
            unchecked.append(name)
    suspects = replace(suspects, off=tuple(off))
    found = {name: one for name in off if (one := resections[name]) is not None and one.better}
    return _with_accused(evidence, cameras, Verdict(suspects, tracks, found, tuple(doubtful), tuple(unchecked)))


def _is_off(found: Resection | None, suspects: Suspects) -> bool:
    return found is not None and found.better and found.given_pixels > suspects.limit_pixels


def _matches(name: str, errors: Mapping[Pair, PairError], suspects: Suspects) -> tuple[int, int]:
    """Numbers of a camera's matches that lie in pairs against its pose and for it."""
    others = set(suspects.off) - {name}
    own = {pair: error.matches for pair, error in errors.items() if name in pair and not set(pair) & others}
    against = sum(matches for pair, matches in own.items() if pair in suspects.bad)
    return against, sum(own.values()) - against


def _with_accused(evidence: Evidence, cameras: Mapping[str, Camera], verdict: Verdict) -> Verdict:
    """The verdict with cameras whose pairs look well, but which see points elsewhere than the others do."""
    suspects, resections, cleared = verdict.suspects, dict(verdict.resections), {*verdict.doubtful, *verdict.unchecked}
    tracks = build_tracks(evidence, cameras, off=suspects.off)
    while (name := accused(tracks, suspects, cleared=cleared)) is not None:
        without = build_tracks(evidence, cameras, off=(*suspects.off, name))
        found = resected(without, cameras[name], name)
        if found is None or not _is_off(found, suspects):
            cleared.add(name)
            continue
        resections[name] = found
        suspects, tracks = replace(suspects, off=(*suspects.off, name)), without
    return replace(verdict, suspects=suspects, tracks=tracks, resections=resections)
