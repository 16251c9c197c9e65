# SPDX-License-Identifier: Apache-2.0
"""The last adjustment of structure from motion: all cameras together, with what alike lenses share."""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from structgstream.data.lenses import Fisheye, LensCamera
from structgstream.geometry import Floats
from structgstream.preparation.calibration.bundle import BodyObservations, Bundle, Parameters, linearized, solved
from structgstream.preparation.calibration.lens_terms import row_of, usual_prior, with_row
from structgstream.preparation.calibration.solved import Observations, SolvedCalibration

_log = logging.getLogger(__name__)


MAX_PIXELS = 3.0
ROUNDS, STEPS, SAME = 8, 2, 0.05
NORMAL_MEDIAN = 1.1774  # of the length of a pair of standard normal numbers


@dataclass(frozen=True)
class Limits:
    """Which observations stay."""

    pixels: float  # largest reprojection error
    degrees: float = 1.5  # smallest angle between the rays of a point

    @classmethod
    def for_pictures(cls, longest_side: int) -> "Limits":
        """Three pixels of pictures of 1000 pixels on the longer side, in proportion, and never under one."""
        return cls(max(1.0, MAX_PIXELS * longest_side / 1000))


def adjust_together(
    found: SolvedCalibration,
    *,
    lens: Sequence[int],
    free: Sequence[int],
    limits: Limits,
) -> SolvedCalibration:
    """``found`` with poses, points and the free terms of its lenses adjusted, without the observations that are off.

    Args:
        lens: number of the lens of each camera; cameras with shared intrinsics have one.
        free: the terms of ``lens_terms.py`` that are estimated.
    """
    bundle, parameters = _problem(found, np.asarray(lens, np.intp), tuple(free))
    bundle, parameters = estimated(bundle, parameters)
    adjusted = _result(found, bundle, parameters)
    inliers = cleaned(adjusted, limits)
    _log_adjustment(adjusted, inliers, bundle)
    again, parameters = _problem(inliers, bundle.lens, bundle.free)
    again = replace(again, prior=bundle.prior, noise=bundle.noise)
    return cleaned(_result(inliers, again, solved(again, parameters)), limits)


def cleaned(found: SolvedCalibration, limits: Limits) -> SolvedCalibration:
    """Without observations that are too far off, and without points whose rays then have too small an angle."""
    seen = found.observations
    with np.errstate(invalid="ignore"):
        good = found.errors() <= limits.pixels
    wide = _angles(found, good) >= np.radians(limits.degrees)
    return chosen(found, good & wide[seen.point])


def chosen(found: SolvedCalibration, good: NDArray[np.bool_]) -> SolvedCalibration:
    """With some of its observations ``[M]`` alone; points without any are left out."""
    seen = found.observations
    inliers, point = np.unique(seen.point[good], return_inverse=True)
    observations = Observations(point.astype(np.intp), seen.camera[good], seen.pixels[good], seen.instant[good])
    return replace(found, points=found.points[inliers], observations=observations)


def _problem(found: SolvedCalibration, lens: NDArray[np.intp], free: tuple[int, ...]) -> tuple[Bundle, Parameters]:
    cameras, seen = list(found.cameras.values()), found.observations
    observations = BodyObservations(seen.camera, seen.point, np.zeros((len(seen), 3)), seen.pixels)
    rotations = np.broadcast_to(np.eye(3), (len(found.points), 3, 3))
    return posed_problem(cameras, observations, (rotations, found.points), lens=lens, free=free, rotating=False)


def posed_problem(
    cameras: Sequence[LensCamera],
    observations: BodyObservations,
    bodies: tuple[Floats, Floats],
    *,
    lens: NDArray[np.intp],
    free: tuple[int, ...],
    rotating: bool,
) -> tuple[Bundle, Parameters]:
    """The problem of cameras that see bodies, with the usual prior of their lenses.

    Args:
        bodies: rotations ``[B, 3, 3]`` and positions ``[B, 3]``.
    """
    _, first = np.unique(lens, return_index=True)
    rows = np.stack([row_of(cameras[index]) for index in first])
    sizes = np.array([[filmed.camera.width, filmed.camera.height] for filmed in cameras], np.float64)
    fisheye = np.array([isinstance(filmed.lens, Fisheye) for filmed in cameras])
    _, alike = np.unique(sizes[first], axis=0, return_inverse=True)
    prior = usual_prior(alike.ravel(), free, fisheye=bool(fisheye.any()))
    views = np.stack([filmed.camera.viewmat.numpy() for filmed in cameras])
    bundle = Bundle(observations, lens, sizes, fisheye, free, rotating, prior)
    return bundle, Parameters(views[:, :3, :3], views[:, :3, 3], rows, *bodies)


def estimated(bundle: Bundle, parameters: Parameters) -> tuple[Bundle, Parameters]:
    """Adjusted, with the noise and the differences of lenses that fit best."""
    poses = bundle.columns[0]
    bundle = _with_noise(bundle, parameters)
    for _ in range(ROUNDS if bundle.free else 1):
        parameters = solved(bundle, parameters, max_steps=STEPS)
        covariance = linearized(bundle, parameters).covariance()
        prior = bundle.prior.updated(parameters.rows, covariance, start=poses, free=bundle.free)
        change = np.abs(prior.differences / bundle.prior.differences - 1).max(initial=0.0)
        bundle = _with_noise(replace(bundle, prior=prior), parameters)
        if change < SAME:
            break
    return bundle, solved(bundle, parameters)


def _with_noise(bundle: Bundle, parameters: Parameters) -> Bundle:
    residuals = np.linalg.norm(bundle.residuals(parameters), axis=1)
    poses, lenses, size = bundle.columns
    left = max(0.1, 1 - (poses + lenses + size * len(parameters.body_positions)) / (2 * len(residuals)))
    return replace(bundle, noise=max(float(np.median(residuals)) / NORMAL_MEDIAN / np.sqrt(left), 1e-3))


def _result(found: SolvedCalibration, bundle: Bundle, parameters: Parameters) -> SolvedCalibration:
    return replace(found, cameras=cameras_in(parameters, found.cameras, bundle.lens), points=parameters.body_positions)


def cameras_in(
    parameters: Parameters, cameras: Mapping[str, LensCamera], lens: NDArray[np.intp]
) -> dict[str, LensCamera]:
    """``cameras`` with the poses and lenses of the parameters."""
    adjusted = {}
    for index, (name, filmed) in enumerate(cameras.items()):
        viewmat = np.eye(4)
        viewmat[:3, :3], viewmat[:3, 3] = parameters.rotations[index], parameters.translations[index]
        adjusted[name] = with_row(filmed, parameters.rows[lens[index]], viewmat)
    return adjusted


def _angles(found: SolvedCalibration, good: NDArray[np.bool_]) -> Floats:
    """Largest angle ``[P]`` between a point's rays, radians; zero for points that less than two cameras see."""
    seen = found.observations
    centers = np.stack([filmed.camera.center.numpy() for filmed in found.cameras.values()])
    rays = centers[seen.camera[good]] - found.points[seen.point[good]]
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    order = np.argsort(seen.point[good], kind="stable")
    rays, points = rays[order], seen.point[good][order]
    widest = np.zeros(len(found.points))
    for step in range(1, int(np.bincount(points).max(initial=0))):
        same = points[step:] == points[:-step]
        sine = np.linalg.norm(np.cross(rays[step:], rays[:-step]), axis=1)
        angle = np.arctan2(sine, (rays[step:] * rays[:-step]).sum(1))
        np.maximum.at(widest, points[step:][same], angle[same])
    return widest


def _log_adjustment(before: SolvedCalibration, after: SolvedCalibration, bundle: Bundle) -> None:
    counts = [np.bincount(own.observations.camera, minlength=len(own.cameras)) for own in (before, after)]
    lost = {name: int(count) for name, count in zip(before.cameras, counts[0] - counts[1], strict=True) if count}
    _log.info(
        "Adjusted: noise %.2f pixels, %d of %d observations removed (%s), lenses of a group differ by %s.",
        bundle.noise, int(sum(lost.values())), len(before.observations),
        ", ".join(f"{name} {count}" for name, count in lost.items()) or "none",
        dict(zip(bundle.prior.terms, bundle.prior.differences.round(5).T.tolist(), strict=True)),
    )  # fmt: skip
