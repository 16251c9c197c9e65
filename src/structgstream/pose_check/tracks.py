# SPDX-License-Identifier: Apache-2.0
"""Matches of one instant's pictures, found without the poses, and the points that several cameras agree on."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from structgstream.cameras import Camera
from structgstream.data.matching import (
    Pair,
    PairError,
    PairMatcher,
    epipolar_errors,
    fundamental_matrix,
    neighbor_pairs,
    pair_error,
    project,
    rays,
)
from structgstream.frames import MultiViewFrame
from structgstream.geometry import Floats, Indices

ALL_PAIRS = 32  # cameras; with more, only neighbours by the given poses are matched
NEIGHBOURS = 8


@dataclass(frozen=True)
class Evidence:
    """Keypoints and matches of one instant."""

    images: Mapping[str, NDArray[np.uint8]]  # name of a camera to its picture ``[H, W, 3]``
    keypoints: Mapping[str, Floats]  # name of a camera to pixels ``[S, 2]``
    matches: Mapping[Pair, Indices]
    """Pair of cameras to numbers of keypoints ``[M, 2]``; empty where they see too little in common."""

    def pixels(self, pair: Pair) -> tuple[Floats, Floats]:
        """Matched pixels ``[M, 2]`` in both pictures."""
        rows = self.matches[pair]
        return self.keypoints[pair[0]][rows[:, 0]], self.keypoints[pair[1]][rows[:, 1]]

    def overlapping(self) -> list[Pair]:
        """Pairs with matches."""
        return [pair for pair, rows in self.matches.items() if len(rows)]


def gather(
    frame: MultiViewFrame,
    cameras: Mapping[str, Camera],
    *,
    matcher: PairMatcher | None = None,
    readings: Collection[Mapping[str, Camera]] = (),
) -> Evidence:
    """Matches of all pairs of a frame's pictures; of large rigs those of neighbours, by the cameras and by
    ``readings``, other poses of the same cameras. ``matcher`` is of the same pictures, where some pairs were matched
    before."""
    names = [name for name in cameras if name in frame.images]
    if len(names) <= ALL_PAIRS:
        pairs = list(combinations(names, 2))
    else:
        rigs = [{name: rig[name] for name in names} for rig in (cameras, *readings)]
        pairs = list(dict.fromkeys(pair for rig in rigs for pair in neighbor_pairs(rig, count=NEIGHBOURS)))
    matcher = matcher or PairMatcher(frame.images, masks=frame.masks)
    matches = matcher.indices(pairs)
    return Evidence(frame.images, {name: matcher.keypoints(name) for name in names if pairs}, matches)


def pair_errors(evidence: Evidence, cameras: Mapping[str, Camera]) -> dict[Pair, PairError]:
    """The error of every pair with matches."""
    return {
        pair: pair_error(cameras[pair[0]], cameras[pair[1]], *evidence.pixels(pair)) for pair in evidence.overlapping()
    }


AGREE_PIXELS = 3.0  # times pixel_scale
MIN_VIEWS = 3
MAX_PAIRS = 45  # of a point's observations, from which it is looked for: all pairs of ten
ROUNDS = 2


def pixel_scale(width: float) -> float:
    """The factor of thresholds in pixels for pictures of this width: 1 up to 1000 pixels, in proportion above."""
    return max(width / 1000, 1)


@dataclass(frozen=True)
class Tracks:
    """Observations of points."""

    names: tuple[str, ...]  # of the cameras; observations number them in this order
    points: Floats  # ``[P, 3]``, triangulated from cameras that are not off
    point: Indices  # ``[M]`` number of the point of each observation
    camera: Indices  # ``[M]`` number of its camera
    pixels: Floats  # ``[M, 2]`` its keypoint
    residuals: Floats  # ``[M]`` its distance to the projected point, pixels

    def of(self, name: str) -> NDArray[np.bool_]:
        """Mask ``[M]`` of a camera's observations; it may have none."""
        return self.camera == (self.names.index(name) if name in self.names else -1)

    @property
    def views(self) -> Indices:
        """Number ``[P]`` of cameras that observed each point."""
        return np.bincount(self.point, minlength=len(self.points))


@dataclass(frozen=True)
class _Table:
    """Observations, and which of them points are made of."""

    point: Indices
    camera: Indices
    pixels: Floats
    used: NDArray[np.bool_]

    def solvable(self) -> "_Table":
        """The observations of points with at least two used ones; points are numbered anew."""
        if not len(self.point):
            return self
        views = np.bincount(self.point[self.used], minlength=int(self.point.max()) + 1)
        rows = views[self.point] >= 2
        _, numbered = np.unique(self.point[rows], return_inverse=True)
        return _Table(numbered.astype(np.intp), self.camera[rows], self.pixels[rows], self.used[rows])


def build_tracks(evidence: Evidence, cameras: Mapping[str, Camera], *, off: Collection[str] = ()) -> Tracks:
    """Points from the matches of cameras that are not ``off``, with all observations of them, also by ``off`` cameras.

    Keypoints that matches connect are one point; a point with two keypoints in one picture is left out. A point lies
    where the rays of its keypoints pass closest (least squares). If its keypoints disagree, only the largest group that
    agrees is used (:func:`_agreeing`).
    """
    names = tuple(name for name in cameras if name in evidence.keypoints)
    limit = AGREE_PIXELS * pixel_scale(max((cameras[name].width for name in names), default=0))
    nodes, edges = _edges(evidence, cameras, names, off=off, limit=limit)
    point, camera, keypoint = _components(nodes, edges, names, evidence)
    pixels = np.empty((len(point), 2))
    for number, name in enumerate(names):
        own = camera == number
        pixels[own] = evidence.keypoints[name][keypoint[own]]
    good = np.array([name not in off for name in names], bool)
    table = _Table(point, camera, pixels, good[camera] if len(camera) else np.empty(0, bool)).solvable()
    in_order = [cameras[name] for name in names]
    table = _agreeing(table, in_order, 3 * limit)
    for _ in range(ROUNDS):  # once more without what disagrees
        points = _closest(table, in_order)
        residuals = _residuals(points, table, in_order)
        table = replace(table, used=good[table.camera] & (residuals < 3 * limit)).solvable()
    points = _closest(table, in_order)
    return Tracks(names, points, table.point, table.camera, table.pixels, _residuals(points, table, in_order))


def _edges(
    evidence: Evidence, cameras: Mapping[str, Camera], names: tuple[str, ...], *, off: Collection[str], limit: float
) -> tuple[Indices, Indices]:
    """First number of each camera's keypoints, and matches ``[E, 2]`` of keypoints by such numbers.

    Matches of cameras that are not off must agree with their poses.
    """
    first = np.cumsum([0, *(len(evidence.keypoints[name]) for name in names)])
    start = dict(zip(names, first, strict=False))
    edges = [np.empty((0, 2), np.intp)]
    for pair in evidence.overlapping():
        if set(pair) <= set(off):
            continue
        rows = evidence.matches[pair]
        if not set(pair) & set(off):
            error = epipolar_errors(fundamental_matrix(cameras[pair[0]], cameras[pair[1]]), *evidence.pixels(pair))
            rows = rows[error < limit]
        edges.append(rows + np.array([start[pair[0]], start[pair[1]]]))
    return first, np.concatenate(edges)


def _components(
    first: Indices, edges: Indices, names: tuple[str, ...], evidence: Evidence
) -> tuple[Indices, Indices, Indices]:
    """Point, camera and keypoint of each observation; a point has two or more pictures, and one keypoint in each."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    total = int(first[-1])
    if not len(edges):
        none = np.empty(0, np.intp)
        return none, none, none
    graph = coo_matrix((np.ones(len(edges), np.int8), edges.T), shape=(total, total))
    _, label = connected_components(graph, directed=False)
    node = np.unique(edges)
    camera = np.searchsorted(first, node, side="right") - 1
    label = label[node]
    _, label = np.unique(label, return_inverse=True)
    once = label * len(names) + camera
    _, position, count = np.unique(once, return_inverse=True, return_counts=True)
    twice = np.zeros(label.max() + 1, bool)
    twice[label[count[position] > 1]] = True
    unique = ~twice[label]
    return label[unique], camera[unique], node[unique] - first[camera[unique]]


def _agreeing(table: _Table, cameras: list[Camera], limit: float) -> _Table:
    """The table without those observations of points that others outvote.

    Least squares of all would put a point with one far-off observation where none of them is. So where they disagree
    the point of each pair is looked at, and that with most observations within ``limit`` pixels counts if these are
    three or more, and most of all; of two equal parties neither is right.
    """
    wrong = table.used & (_residuals(_closest(table, cameras), table, cameras) >= limit)
    doubted = np.unique(table.point[wrong])
    used = table.used.copy()
    rows = np.flatnonzero(table.used & np.isin(table.point, doubted))
    rows = rows[np.argsort(table.point[rows], kind="stable")]
    for own in np.split(rows, np.flatnonzero(np.diff(table.point[rows])) + 1):
        if len(own) <= MIN_VIEWS:  # two of three always agree
            continue
        pairs = np.stack(np.triu_indices(len(own), 1), axis=1)
        pairs = pairs[np.unique(np.linspace(0, len(pairs) - 1, MAX_PAIRS).round().astype(int))]
        each = _Table(
            np.repeat(np.arange(len(pairs)), len(own)),
            np.tile(table.camera[own], len(pairs)),
            np.tile(table.pixels[own], (len(pairs), 1)),
            (np.arange(len(own)) == pairs[:, :1]).ravel() | (np.arange(len(own)) == pairs[:, 1:]).ravel(),
        )
        errors = _residuals(_closest(each, cameras), each, cameras).reshape(len(pairs), len(own))
        within = errors < limit
        best = np.lexsort((np.where(within, errors, limit).sum(1), -within.sum(1)))[0]
        rivals = within[(within & ~within[best]).any(1)].sum(1).max(initial=0)
        if within[best].sum() > max(rivals, MIN_VIEWS - 1, len(own) / 2):
            used[own] = within[best]
    return replace(table, used=used)


def _closest(table: _Table, cameras: list[Camera]) -> Floats:
    """Points ``[P, 3]`` with the least sum of squared distances to the rays of their used observations."""
    count = int(table.point.max()) + 1 if len(table.point) else 0
    left, right = np.zeros((count, 3, 3)), np.zeros((count, 3))
    for number, own in enumerate(cameras):
        rows = (table.camera == number) & table.used
        directions = rays(own, table.pixels[rows])
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        across = np.eye(3) - directions[:, :, None] * directions[:, None, :]
        np.add.at(left, table.point[rows], across)
        np.add.at(right, table.point[rows], across @ own.center.numpy())
    # Nearly parallel rays meet far away; the floor keeps the system solvable.
    return np.linalg.solve(left + 1e-9 * np.eye(3), right[..., None])[..., 0].astype(np.float64)


def _residuals(points: Floats, table: _Table, cameras: list[Camera]) -> Floats:
    residuals = np.full(len(table.point), np.inf)
    for number, own in enumerate(cameras):
        rows = table.camera == number
        seen, depths = project(own, points[table.point[rows]])
        residuals[rows] = np.where(depths > 0, np.linalg.norm(seen - table.pixels[rows], axis=1), np.inf)
    return residuals
