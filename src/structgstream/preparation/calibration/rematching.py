# SPDX-License-Identifier: Apache-2.0
"""Matches found again with the help of a first solution, and the solution adjusted to them.

Note [What a first solution lacks]: the first matches are those that stand out among all keypoints of a picture. In bare
rooms they are few and lie on walls, at one depth, where a camera's place can be exchanged for its focal length. Points
that three cameras confirm near the epipolar lines of the first solution are more, and of more depths.
"""

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from structgstream.data.matching import Pair
from structgstream.preparation.calibration.adjustment import Limits, chosen
from structgstream.preparation.calibration.colmap import pycolmap_module
from structgstream.preparation.calibration.keypoints import Keypoints
from structgstream.preparation.calibration.mapping import filtered, observed
from structgstream.preparation.calibration.matching import GuidedMatchConfig, guided_matches
from structgstream.preparation.calibration.solved import Observations, SolvedCalibration
from structgstream.preparation.calibration.triangulation import PosedGraph, posed_model

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class RematchConfig:
    """Configuration of matching again.

    Args:
        matching: which keypoints match.
        enough: observations that each camera has in a first solution that is left as it is.
        views: least number of cameras that see a point: two agree on their epipolar line by chance.
        gain: least ratio of the observations then to those before; for fewer the first solution stays.
        slack_degrees: largest angle between a ray and its point.
    """

    matching: GuidedMatchConfig = field(default_factory=GuidedMatchConfig)
    enough: int = 1000
    views: int = 3
    gain: float = 1.3
    slack_degrees: float = 0.4


def rematched(
    found: SolvedCalibration,
    keypoints: Mapping[str, Keypoints],
    *,
    limits: Limits,
    adjust: Callable[[SolvedCalibration], SolvedCalibration],
    workers: int,
    config: RematchConfig = RematchConfig(),
) -> SolvedCalibration:
    """``found`` adjusted to more points; itself if it has enough, little is gained or a camera loses some.

    Args:
        found: a first solution (Note [What a first solution lacks]).
        keypoints: of its cameras, by name.
        limits: which observations stay.
        adjust: adjusts cameras and points together.
        workers: threads.
        config: when it is done, and what is kept.
    """
    before = _counts(found)
    if before.min() >= config.enough:
        return found
    guided = guided_matches(keypoints, found.cameras, pixels=limits.pixels, workers=workers, config=config.matching)
    made = _triangulated(found, keypoints, guided, limits=limits, config=config)
    joined = _joined(made, _confirmed(found, config.views))
    again = adjust(joined) if len(joined.observations) >= config.gain * before.sum() else found
    after = _counts(again)
    if again is found or (after < before).any():
        _log.info("Matching again gives a camera hardly more or fewer observations; the first solution is kept.")
        return found
    _log.info("Matched again: %d observations in place of %d.", after.sum(), before.sum())
    return again


def _counts(found: SolvedCalibration) -> NDArray[np.intp]:
    """Observations ``[C]`` of each camera."""
    return np.bincount(found.observations.camera, minlength=len(found.cameras))


def _triangulated(
    found: SolvedCalibration,
    keypoints: Mapping[str, Keypoints],
    matches: Mapping[Pair, NDArray[np.uint32]],
    *,
    limits: Limits,
    config: RematchConfig,
) -> SolvedCalibration:
    """Points that enough cameras of ``found`` confirm."""
    geometries = {pair: _geometry(rows) for pair, rows in matches.items() if len(rows)}
    graph = PosedGraph({name: keypoints[name] for name in found.cameras}, matches, geometries)
    model = posed_model(graph, found.cameras, pixels=limits.pixels, slack_degrees=config.slack_degrees)
    filtered(model, pixels=limits.pixels, degrees=limits.degrees)
    points, observations = observed(model, graph.keypoints, {name: index for index, name in enumerate(found.cameras)})
    made = replace(found, points=points, observations=observations)
    return _confirmed(made, config.views)


def _confirmed(found: SolvedCalibration, views: int) -> SolvedCalibration:
    """With the points alone that so many cameras see."""
    return chosen(found, (found.track_lengths() >= views)[found.observations.point])


def _geometry(rows: NDArray[np.uint32]) -> Any:
    pycolmap = pycolmap_module()
    geometry = pycolmap.TwoViewGeometry()
    geometry.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
    geometry.inlier_matches = rows
    return geometry


def _joined(many: SolvedCalibration, few: SolvedCalibration) -> SolvedCalibration:
    """The points of ``many``, and those of ``few`` that share no keypoint with them."""
    one, two = many.observations, few.observations
    keys = np.concatenate([np.column_stack([seen.camera, seen.pixels]) for seen in (one, two)])
    _, key = np.unique(keys, axis=0, return_inverse=True)
    key = key.ravel()
    shared = np.zeros(len(few.points), bool)
    shared[two.point[np.isin(key[len(one) :], key[: len(one)])]] = True
    rest = chosen(few, ~shared[two.point])
    last = rest.observations
    observations = Observations(
        np.concatenate([one.point, last.point + len(many.points)]),
        *(np.concatenate([getattr(one, part), getattr(last, part)]) for part in ("camera", "pixels", "instant")),
    )
    return replace(many, points=np.concatenate([many.points, rest.points]), observations=observations)
