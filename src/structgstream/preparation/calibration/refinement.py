# SPDX-License-Identifier: Apache-2.0
"""Refinement of given poses by bundle adjustment over matched tracks."""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from structgstream.data.lenses import LensCamera
from structgstream.data.matching import Pair, connected_groups
from structgstream.errors import CalibrationError, ConfigError
from structgstream.preparation.calibration.adjustment import Limits, adjust_together
from structgstream.preparation.calibration.colmap import MODELS, LensModel, holding
from structgstream.preparation.calibration.lens_terms import ASPECT, DISTORTION, FOCAL
from structgstream.preparation.calibration.mapping import adjust, cameras_of, filtered, observed
from structgstream.preparation.calibration.matching import epipolar_pixels
from structgstream.preparation.calibration.solved import SolvedCalibration, normalized, rig_alignment
from structgstream.preparation.calibration.triangulation import (
    PosedGraph,
    posed_graph,
    posed_model,
    triangulated,
    without,
)

_log = logging.getLogger(__name__)

SLACK_DEGREES = 1.5  # of matches to the epipolar planes of the given poses, so how wrong these may be
ROUNDS = (1.0, 0.4, 0.2)  # shares of the slack
HELD_OUT_TRACKS = 5  # one in five tracks judges and is not adjusted
MIN_HELD_OUT = 30


@dataclass(frozen=True)
class Refinement:
    """The result of a refinement."""

    solved: SolvedCalibration
    """Refined cameras, in the coordinates of the given ones; these themselves if refining did not help."""
    before_pixels: float  # median distance of matches that were held out to the epipolar lines of the given cameras
    after_pixels: float  # the same of the refined cameras, before they are adjusted to these matches, too
    held_out: int  # number of these matches
    changed: bool  # whether ``solved`` has refined cameras


def refine(
    pictures: Mapping[str, Sequence[NDArray[np.uint8]]],
    cameras: Mapping[str, LensCamera],
    *,
    lens: LensModel | None = None,
    metres: bool = False,
) -> Refinement:
    """Adjust ``cameras`` to pictures of the same instants.

    One track in five is held out. Only if the refined cameras fit these better than the given ones do, they are
    returned, after a last adjustment to all tracks (adjustment.py); they are moved, turned and scaled to lie as close
    to the given ones as they can.

    Args:
        lens: the model of lenses whose distortion is estimated, too; by default the given distortion stays, and only
            poses and focal lengths move.
        metres: whether the given cameras are in metres.

    Raises:
        CalibrationError: too few matches agree with the given poses, or not all cameras are connected by them.
        ConfigError: the model ``brown``.
    """
    if lens == "brown":
        raise ConfigError(
            "Lenses of the model brown cannot be refined; take opencv, or leave the lens out to keep the given model."
        )
    graph = posed_graph(pictures, cameras, slack_degrees=SLACK_DEGREES)
    _check_connected(cameras, graph)
    judging = _held_out(graph)
    learning = without(graph, judging)
    judges = {pair: graph.matches[pair][judging[pair]] for pair in graph.matches}
    refined = dict(cameras)
    models = {name: MODELS[lens] if lens else holding(filmed.lens) for name, filmed in cameras.items()}
    limits = Limits.for_pictures(max(max(filmed.camera.width, filmed.camera.height) for filmed in cameras.values()))
    model = None
    for share in ROUNDS:
        slack = SLACK_DEGREES * share
        focal = max(float(filmed.camera.K[0, 0]) for filmed in refined.values())
        loose = max(limits.pixels, focal * float(np.radians(slack)))
        model = posed_model(learning, refined, pixels=loose, slack_degrees=slack, models=models)
        adjust(model, lens=lens is not None)
        filtered(model, pixels=limits.pixels, degrees=limits.degrees)
        adjust(model, lens=lens is not None)
        found = cameras_of(model)
        refined = {name: found[name] for name in cameras}
    result = SolvedCalibration(refined, *observed(model, graph.keypoints, cameras))
    result = result.aligned(rig_alignment(refined, cameras), metres=metres)
    before, after = (_judged(graph, judges, which) for which in (cameras, result.cameras))
    count = sum(map(len, judges.values()))
    if after < before:
        terms = (FOCAL, ASPECT, *(DISTORTION[lens] if lens else ()))
        everything = _completed(graph, result, terms, limits=limits)
        everything = everything.aligned(rig_alignment(everything.cameras, cameras), metres=metres)
        if _judged(graph, judges, everything.cameras) <= after:
            result = everything
        return Refinement(result, before, after, count, True)
    _log.warning(
        "Refining does not help: matches that were held out are %.2f pixels off with the given cameras and %.2f with "
        "refined ones; the given ones stay.", before, after,
    )  # fmt: skip
    given = triangulated(graph, cameras, limits=limits)
    return Refinement(replace(given, metres=metres), before, after, count, False)


def _completed(
    graph: PosedGraph, refined: SolvedCalibration, terms: tuple[int, ...], *, limits: Limits
) -> SolvedCalibration:
    """``refined`` adjusted to all tracks, the held-out ones included, with what alike lenses share."""
    count = len(refined.cameras)
    return adjust_together(
        normalized(triangulated(graph, refined.cameras, limits=limits)),
        lens=range(count),
        free=terms,
        limits=limits,
    )


def _check_connected(cameras: Mapping[str, LensCamera], graph: PosedGraph) -> None:
    groups = connected_groups(cameras, graph.matches)
    if len(groups) > 1:
        alone = ", ".join(repr(name) for group in groups[1:] for name in group)
        raise CalibrationError(
            f"Too few matches agree with the given poses of {alone} to refine them with the others: the poses are off "
            "by more than the refinement reaches, cameras are mixed up, or they see too little in common."
        )


def _held_out(graph: PosedGraph) -> dict[Pair, NDArray[np.bool_]]:
    """Which matches belong to the tracks that judge; a track is all keypoints that matches connect."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    starts = dict(zip(graph.keypoints, np.cumsum([0, *map(len, graph.keypoints.values())])))
    total = sum(map(len, graph.keypoints.values()))
    ends = [
        (starts[one] + found[:, 0].astype(np.intp), starts[two] + found[:, 1].astype(np.intp))
        for (one, two), found in graph.matches.items()
    ]
    first, second = (np.concatenate(side) for side in zip(*ends, strict=True))
    links = coo_array((np.ones(len(first)), (first, second)), shape=(total, total))
    _, track = connected_components(links, directed=False)
    # A track's number follows the order of its first keypoint; a shuffle spreads those that judge.
    chosen = np.random.default_rng(0).permutation(track.max() + 1) % HELD_OUT_TRACKS == 0
    judging = {pair: chosen[track[one]] for pair, (one, _) in zip(graph.matches, ends, strict=True)}
    if sum(int(fixed.sum()) for fixed in judging.values()) < MIN_HELD_OUT:
        raise CalibrationError(
            f"Only {len(first)} matches agree with the given poses, too few to refine them: take more instants, or "
            "let neighbouring cameras see more of the same."
        )
    return judging


def _judged(graph: PosedGraph, judges: Mapping[Pair, NDArray[np.uint32]], cameras: Mapping[str, LensCamera]) -> float:
    errors = epipolar_pixels(graph.keypoints, judges, cameras)
    return float(np.nanmedian(np.concatenate(list(errors.values()))))
