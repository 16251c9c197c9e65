# SPDX-License-Identifier: Apache-2.0
"""Which cameras are off, and by how much: those that disagree with others which agree with each other.

Matches that contradict a pose may be wrong matches: of a court or a facade they even fit some epipolar geometry. A
camera that is off has another pose, or another focal length, which explains what the given one does not (resection);
wrong matches have none."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from structgstream.cameras import Camera
from structgstream.data.images import opencv
from structgstream.data.matching import Pair, PairError, project
from structgstream.geometry import Floats
from structgstream.pose_check.tracks import (
    AGREE_PIXELS,
    MIN_VIEWS,
    Evidence,
    Tracks,
    build_tracks,
    pair_errors,
    pixel_scale,
)

MIN_SEEN = 8
MIN_POINTS = 12
MIN_SHARE = 0.4  # of a camera's points that a corrected camera must explain
MIN_GAIN = 0.5  # largest share of the error that a correction leaves, if the camera is to be off
SIMPLE_ENOUGH = 1.1  # of the smallest error, up to which the correction with fewer causes is taken
SIGMAS = 3.0
TURN, MOVE, FOCAL = slice(0, 3), slice(3, 6), slice(6, 7)
BY_CHANCE = 3  # points that a pose may explain beyond those that another one does, as it has six degrees of freedom
CAUSES: tuple[tuple[slice, ...], ...] = ((TURN,), (FOCAL,), (MOVE,), (TURN, FOCAL), (TURN, MOVE), (TURN, MOVE, FOCAL))


@dataclass(frozen=True)
class Resection:
    """A camera corrected to points of the others; errors are standard errors."""

    points: int  # number of points that it explains
    given_points: int  # number of points that the given camera explains
    seen: int  # number of points that have a keypoint in its picture
    given_pixels: float  # median distance of the keypoints of ``points`` to where the given camera sees these
    corrected_pixels: float  # the same of the corrected one
    degrees: float  # by how much its axis and picture turn
    degrees_error: float  # of that
    share_of_distance: float  # by how much it moves, as a share of its distance to the points
    share_error: float  # of that
    focal_percent: float  # by how much its focal length grows
    focal_error: float  # of that

    @property
    def better(self) -> bool:
        """Whether the corrected camera explains most points, and these much better than the given one."""
        enough = self.points >= max(MIN_POINTS, MIN_SHARE * self.seen)
        return enough and self.corrected_pixels < MIN_GAIN * self.given_pixels

    @property
    def as_given(self) -> bool:
        """Whether no other camera explains more than the given one, so that what contradicts it are wrong matches."""
        return not self.better and self.given_points >= max(
            MIN_SEEN // 2, MIN_SHARE * self.seen, self.points - BY_CHANCE
        )

    @property
    def description(self) -> str:
        """By how much the camera is off, as far as that is beyond chance; empty if nothing is."""
        away = []
        if self.degrees > SIGMAS * self.degrees_error:
            away.append(f"{self.degrees:.2f} degrees (± {max(self.degrees_error, 0.01):.2f})")
        if self.share_of_distance > SIGMAS * self.share_error:
            error = max(100 * self.share_error, 0.1)
            away.append(f"{self.share_of_distance:.1%} (± {error:.1f}%) of its distance to the scene")
        parts = [f"place it {' and '.join(away)} away"] if away else []
        if abs(self.focal_percent) > SIGMAS * self.focal_error:
            longer = "longer" if self.focal_percent > 0 else "shorter"
            error = max(self.focal_error, 0.1)
            parts.append(f"give it a focal length {abs(self.focal_percent):.1f}% (± {error:.1f}%) {longer}")
        return " and ".join(parts)


@dataclass(frozen=True)
class _View:
    """A camera to be corrected: seven numbers turn its axes, move its centre and lengthen its focal length."""

    rotation: Floats
    center: Floats
    focal: Floats
    principal: Floats
    skew: float

    def pixels(self, change: Floats, points: Floats) -> Floats:
        cv2 = opencv()
        turn = cv2.Rodrigues(np.asarray(change[TURN], np.float64))[0]
        seen = (points - self.center - change[MOVE]) @ (turn @ self.rotation).T
        depth = np.where(np.abs(seen[:, 2:]) < 1e-12, 1e-12, seen[:, 2:])
        flat = np.where(depth > 0, seen[:, :2] / depth, 1e6)
        flat = flat + np.stack([self.skew / self.focal[0] * flat[:, 1], np.zeros(len(flat))], 1)
        return flat * self.focal * np.exp(change[FOCAL]) + self.principal


def resect(tracks: Tracks, camera: Camera, name: str) -> Resection | None:
    """What corrects a camera to the points that others agree on; None if too few of them are in its picture.

    ``tracks`` have the camera among those that are off, so that no point is made of its keypoints.
    """
    own = tracks.of(name)
    if own.sum() < MIN_SEEN:
        return None
    points, pixels = tracks.points[tracks.point[own]], tracks.pixels[own]
    limit = AGREE_PIXELS * pixel_scale(camera.width)
    K = camera.K.numpy()
    focal, principal, skew = K.diagonal()[:2].copy(), K[:2, 2].copy(), float(K[0, 1])
    view = _View(camera.viewmat.numpy()[:3, :3], camera.center.numpy(), focal, principal, skew)
    starts = [start for start in (np.zeros(7), _by_points(camera, points, pixels, limit)) if start is not None]
    best = max((_adjusted(view, start, points, pixels, limit) for start in starts), key=lambda found: found[1].sum())
    change, fits = best
    given_points = np.linalg.norm(project(camera, points)[0] - pixels, axis=1) < limit
    if fits.sum() < max(MIN_SEEN, given_points.sum()):  # nothing explains more than the given camera
        change, fits = np.zeros(7), given_points
    if fits.sum() < MIN_SEEN // 2:
        return None
    change, errors = _simplest(view, change, points[fits], pixels[fits], limit)
    distance = float(np.median(np.linalg.norm(points[fits] - view.center - change[MOVE], axis=1)))
    given = np.linalg.norm(project(camera, points[fits])[0] - pixels[fits], axis=1)
    corrected = np.linalg.norm(view.pixels(change, points[fits]) - pixels[fits], axis=1)
    turned, moved = float(np.linalg.norm(change[TURN])), float(np.linalg.norm(change[MOVE]))
    return Resection(
        points=int(fits.sum()),
        given_points=int(given_points.sum()),
        seen=int(own.sum()),
        given_pixels=float(np.median(given)),
        corrected_pixels=float(np.median(corrected)),
        degrees=float(np.degrees(turned)),
        degrees_error=float(np.degrees(errors[0])),
        share_of_distance=moved / max(distance, 1e-12),
        share_error=errors[1] / max(distance, 1e-12),
        focal_percent=float(100 * np.expm1(change[6])),
        focal_error=100 * errors[2],
    )


def explained(tracks: Tracks, camera: Camera, name: str) -> int:
    """Number of points that lie near their keypoints in a camera's picture if that is ``camera``."""
    own = tracks.of(name)
    seen, depths = project(camera, tracks.points[tracks.point[own]])
    distances = np.linalg.norm(seen - tracks.pixels[own], axis=1)
    return int(((depths > 0) & (distances < 2 * AGREE_PIXELS * pixel_scale(camera.width))).sum())


def _by_points(camera: Camera, points: Floats, pixels: Floats, limit: float) -> Floats | None:
    """The change to a pose from scratch, so that a camera may be off by any amount."""
    cv2 = opencv()
    found, turn, shift, inliers = cv2.solvePnPRansac(
        points, pixels, camera.K.numpy(), None, reprojectionError=limit, iterationsCount=500
    )
    if not found or inliers is None or not np.isfinite(turn).all():
        return None
    rotation = cv2.Rodrigues(turn)[0]
    change = np.zeros(7)
    change[TURN] = cv2.Rodrigues(rotation @ camera.viewmat.numpy()[:3, :3].T)[0][:, 0]
    change[MOVE] = -rotation.T @ shift[:, 0] - camera.center.numpy()
    return change


def _adjusted(view: _View, start: Floats, points: Floats, pixels: Floats, limit: float) -> tuple[Floats, np.ndarray]:
    """The change with all causes from a start, and the mask of points that it explains."""
    change = start
    for _ in range(2):
        near = np.linalg.norm(view.pixels(change, points) - pixels, axis=1) < 4 * limit
        if near.sum() < MIN_SEEN // 2:
            return change, near & False
        change = _solved(view, change, points[near], pixels[near], CAUSES[-1], limit)[0]
    return change, np.linalg.norm(view.pixels(change, points) - pixels, axis=1) < limit


def _simplest(
    view: _View, change: Floats, points: Floats, pixels: Floats, limit: float
) -> tuple[Floats, tuple[float, float, float]]:
    """The change with the fewest causes that explains the points as well as all causes do, and its standard errors."""
    solved = []
    for causes in CAUSES:
        start = np.zeros(7)
        for cause in causes:
            start[cause] = change[cause]
        solved.append(_solved(view, start, points, pixels, causes, limit))
    min_error = solved[-1][1]
    found, _, covariance = next(one for one in solved if one[1] <= SIMPLE_ENOUGH * min_error)
    return found, tuple(_error(found[cause], covariance[cause, cause]) for cause in (TURN, MOVE, FOCAL))  # pyright: ignore[reportReturnType]


def _solved(
    view: _View, start: Floats, points: Floats, pixels: Floats, causes: Sequence[slice], limit: float
) -> tuple[Floats, float, Floats]:
    """The change by some causes, the root mean square of what is left in pixels, and its covariance ``[7, 7]``."""
    from scipy.optimize import least_squares

    free = np.concatenate([np.arange(7)[cause] for cause in causes])
    scales = np.ones(7)
    scales[MOVE] = max(float(np.median(np.linalg.norm(points - view.center, axis=1))), 1e-9)

    def left(values: Floats) -> Floats:
        change = np.zeros(7)
        change[free] = values * scales[free]
        return (view.pixels(change, points) - pixels).ravel()

    found = least_squares(left, start[free] / scales[free], loss="soft_l1", f_scale=limit / 3, max_nfev=60)
    change, covariance = np.zeros(7), np.zeros((7, 7))
    change[free] = found.x * scales[free]
    rest = left(found.x)
    variance = float((rest**2).sum()) / max(len(rest) - len(free), 1)
    inverse = np.linalg.pinv(found.jac.T @ found.jac) * variance
    covariance[np.ix_(free, free)] = inverse * np.outer(scales[free], scales[free])
    return change, float(np.sqrt(2 * found.cost / len(rest))), covariance


def _error(values: Floats, covariance: Floats) -> float:
    """Standard error of the length of a vector."""
    length = np.linalg.norm(values)
    if length == 0:
        return float(np.sqrt(np.trace(covariance)))
    axis = values / length
    return float(np.sqrt(max(axis @ covariance @ axis, 0.0)))


TIMES_TYPICAL = 4.0
FLOOR_PIXELS = 0.75  # times pixel_scale
MAX_WEIGHT = 100  # matches above which a pair is not trusted more
OFF_SHARE = 0.5
VIOLATING_SHARE = 0.5
MIN_OUTLIER_POINTS, MIN_CAMERAS, OUTLIER_RATIO = 15, 4, 2.5
MIN_MATCHES = 60  # of a camera's pairs, from which on they count without points; chance makes 20 to 25


@dataclass(frozen=True)
class Suspects:
    """The verdict on a rig."""

    off: tuple[str, ...]  # cameras that disagree with the others, the worst first
    bad: tuple[Pair, ...]  # pairs that the poses do not explain
    limit_pixels: float  # error above which a pair counts as such
    everything: bool  # whether so much disagrees that no camera can be singled out

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
        worst = max(remaining, key=lambda name: (shares[name], _median_error(name, errors, off)))
        if shares[worst] < OFF_SHARE:
            break
        off.append(worst)
        remaining.remove(worst)
    seen = len(off) + len(remaining)
    everything = bool(off) and len(remaining) < max(2, (seen + 1) // 2)
    return Suspects(tuple(off), tuple(pair for pair in errors if pair in bad), limit, everything)


def track_outlier(tracks: Tracks, suspects: Suspects, *, cleared: Collection[str] = ()) -> str | None:
    """The camera, if any, whose observations lie farther from the points of the others than theirs, although its pairs
    look well; none that is ``cleared``.

    Along an epipolar line a match may lie anywhere: in a row of cameras, no pair reveals one that was turned along it.
    Points of several cameras, which are not off, do.
    """
    medians = {}
    for name in tracks.names:
        seen = tracks.residuals[tracks.of(name) & (tracks.views[tracks.point] >= MIN_VIEWS)]
        if name not in suspects.off and len(seen) >= MIN_OUTLIER_POINTS:
            medians[name] = float(np.median(seen))
    if len(medians) < MIN_CAMERAS:
        return None
    worst = max((name for name in medians if name not in cleared), key=lambda name: medians[name], default=None)
    if worst is None:
        return None
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


def _median_error(name: str, errors: Mapping[Pair, PairError], off: Collection[str]) -> float:
    """Median error of a camera's pairs, to choose among cameras of equal shares."""
    own = [error.pixels for pair, error in errors.items() if name in pair and not set(pair) & set(off)]
    return float(np.median(own)) if own else 0.0


@dataclass(frozen=True)
class Verdict:
    """What is off, and by what evidence."""

    suspects: Suspects  # the cameras that are off
    tracks: Tracks  # points of the others
    resections: Mapping[str, Resection] = field(default_factory=dict)
    """Corrections of cameras that are off, where there are points for that."""
    doubtful: tuple[str, ...] = ()  # cameras that matches contradict, but others fit
    unchecked: tuple[str, ...] = ()  # cameras that so few matches contradict that chance may have made them


def judge(evidence: Evidence, cameras: Mapping[str, Camera]) -> Verdict:
    """Names the cameras that are off.

    Pairs raise a suspicion; then points of the other cameras decide. A camera is off if another pose or focal length
    explains these points much better than the given one, and is not off if none explains more of them. Where points do
    not decide, it is off if :data:`MIN_MATCHES` of its matches contradict its pose and none agrees with it; else it is
    doubtful or, with fewer matches, unchecked.
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
