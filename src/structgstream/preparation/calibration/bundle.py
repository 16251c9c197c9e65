# SPDX-License-Identifier: Apache-2.0
"""Bundle adjustment of cameras that are alike, which COLMAP's has no terms for, and the last one of a calibration.

Cameras and bodies are adjusted; bodies are points, or poses of a board whose corners are known. They are eliminated
from the normal equations (Brown, 1958; Triggs et al., Bundle adjustment: a modern synthesis, 2000), which are solved by
Levenberg's and Marquardt's method with Huber's loss. Terms of intrinsics may have a prior that cameras share
(``lens_terms.py``)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from structgstream.data.calibration import rigid, rotation_matrix
from structgstream.data.lenses import Fisheye, LensCamera
from structgstream.geometry import Floats, Indices, cross_matrices
from structgstream.preparation.calibration.lens_terms import (
    LensPrior,
    derivatives,
    projected,
    row_of,
    usual_prior,
    with_row,
)
from structgstream.preparation.calibration.solved import Observations, SolvedCalibration

HUBER = 1.345  # standard deviations of the noise: 95 % as exact as least squares if there are no outliers
RIDGE = 1e-10  # of the diagonal: the equations do not fix where the world's axes are
MAX_STEPS = 50
SMALL = 1e-6


@dataclass(frozen=True)
class BodyObservations:
    """What was observed."""

    camera: Indices  # ``[M]``
    body: Indices  # ``[M]``
    offset: Floats  # ``[M, 3]``, from the body's origin in its axes; zeros for points
    pixels: Floats  # ``[M, 2]``


@dataclass(frozen=True)
class Parameters:
    """Everything that is adjusted: poses and lenses of cameras, poses of bodies."""

    rotations: Floats  # ``[C, 3, 3]``, world to camera
    translations: Floats  # ``[C, 3]``
    rows: Floats  # ``[L, TERMS]`` of the lenses
    body_rotations: Floats  # ``[B, 3, 3]`` of the bodies, body to world; identities for points
    body_positions: Floats  # ``[B, 3]`` of the bodies


@dataclass(frozen=True)
class Bundle:
    """A problem of bundle adjustment."""

    observations: BodyObservations  # of the bodies
    lens: Indices  # ``[C]``, which row of lenses a camera has
    sizes: Floats  # ``[C, 2]``, width and height of the pictures
    fisheye: NDArray[np.bool_]  # ``[C]``, whether a camera's terms are a fisheye's
    free: tuple[int, ...]  # the terms of the rows that are estimated
    rotating: bool  # whether bodies have rotations
    prior: LensPrior  # of the terms
    noise: float = 0.5  # standard deviation of the pixels

    @property
    def columns(self) -> tuple[int, int, int]:
        """Number of parameters of poses, of lenses, and of a body."""
        return 6 * len(self.lens), (int(self.lens.max()) + 1) * len(self.free), 6 if self.rotating else 3

    def residuals(self, parameters: Parameters) -> Floats:
        """Projected minus observed ``[M, 2]``, pixels; infinite behind a camera."""
        own, (_, _, local) = self.observations.camera, self.in_cameras(parameters)
        ahead = local[:, 2] > 0
        safe = np.where(ahead[:, None], local, [0.0, 0.0, 1.0])
        found = projected(safe, parameters.rows[self.lens[own]], self.sizes[own], self.fisheye[own])
        return np.where(ahead[:, None], found - self.observations.pixels, np.inf)

    def cost(self, parameters: Parameters) -> float:
        """Huber's loss of the misses, and what the prior adds."""
        off = np.linalg.norm(self.residuals(parameters), axis=1) / self.noise
        if not np.isfinite(off).all():
            return float("inf")
        loss = np.where(off <= HUBER, off**2 / 2, HUBER * off - HUBER**2 / 2)
        return float(loss.sum()) + self.prior.cost(parameters.rows)

    def in_cameras(self, parameters: Parameters) -> tuple[Floats, Floats, Floats]:
        """What was observed ``[M, 3]``: in the axes of the world from the body's origin, in those of its camera from
        the world's origin, and from the camera's."""
        seen = self.observations
        on_body = np.einsum("mab,mb->ma", parameters.body_rotations[seen.body], seen.offset)
        world = on_body + parameters.body_positions[seen.body]
        turned = np.einsum("mab,mb->ma", parameters.rotations[seen.camera], world)
        return on_body, turned, turned + parameters.translations[seen.camera]


def solved(bundle: Bundle, parameters: Parameters, *, max_steps: int = MAX_STEPS) -> Parameters:
    """The parameters of least cost near ``parameters``, or after ``max_steps`` steps."""
    damping, cost = 1e-4, bundle.cost(parameters)
    for _ in range(max_steps):
        system = linearized(bundle, parameters)
        for _ in range(10):
            tried = system.stepped(bundle, parameters, damping)
            new = bundle.cost(tried)
            if new <= cost:
                break
            damping *= 10
        else:
            return parameters
        gained, parameters, cost, damping = cost - new, tried, new, max(damping / 10, 1e-9)
        if gained < SMALL * cost:
            break
    return parameters


@dataclass(frozen=True)
class System:
    """Normal equations: ``[[A, W], [W^T, V]]`` of cameras, with lenses and prior, and of bodies."""

    A: Floats
    V: Floats
    W: Any
    gradient: Floats
    body_gradient: Floats

    def reduced(self, damping: float) -> tuple[Floats, Floats, Floats]:
        """Equations of cameras alone and their right side; and the inverses ``[B, q, q]`` of the bodies' own."""
        from scipy.sparse import bsr_array

        diagonal = np.einsum("bii->bi", self.V)
        count, size = diagonal.shape
        damped = self.V + (damping * diagonal + 1e-12)[:, :, None] * np.eye(size)
        inverse: Floats = np.asarray(np.linalg.inv(damped), np.float64)
        blocks = bsr_array((inverse, np.arange(count), np.arange(count + 1)), shape=(count * size, count * size))
        weighed = self.W @ blocks.tocsr()
        own = np.diag(self.A)
        left = self.A + np.diag((damping + RIDGE) * own) - (weighed @ self.W.T).toarray()
        return left, self.gradient - weighed @ self.body_gradient.ravel(), inverse

    def stepped(self, bundle: Bundle, parameters: Parameters, damping: float) -> Parameters:
        """The parameters after one damped step."""
        left, right, inverse = self.reduced(damping)
        step: Floats = np.asarray(-np.linalg.solve(left, right), np.float64)
        rest = self.body_gradient + (self.W.T @ step).reshape(self.body_gradient.shape)
        return _moved(bundle, parameters, step, -np.einsum("bij,bj->bi", inverse, rest))

    def covariance(self) -> Floats:
        """Of poses and lenses, in that order."""
        left, _, _ = self.reduced(0.0)
        scale = np.sqrt(np.diag(left)) + 1e-300
        return np.linalg.inv(left / np.outer(scale, scale)) / np.outer(scale, scale)


def linearized(bundle: Bundle, parameters: Parameters) -> System:
    """The normal equations at ``parameters``."""
    from scipy.sparse import csr_array

    poses, lenses, size = bundle.columns
    by_camera, by_body, columns = _derivatives(bundle, parameters)
    residuals = bundle.residuals(parameters)
    off = np.linalg.norm(residuals, axis=1) / bundle.noise
    weight = np.where(off <= HUBER, 1.0, HUBER / np.maximum(off, HUBER)) / bundle.noise**2
    total = poses + lenses
    A, gradient = np.zeros((total, total)), np.zeros(total)
    for camera in range(len(bundle.lens)):
        own = np.flatnonzero(bundle.observations.camera == camera)
        if len(own):
            J, w = by_camera[own], weight[own]
            where = columns[own[0]]
            A[np.ix_(where, where)] += np.einsum("m,mai,maj->ij", w, J, J, optimize=True)
            gradient[where] += np.einsum("m,mai,ma->i", w, J, residuals[own])
    bundle.prior.add(A, gradient, parameters.rows, start=poses, free=bundle.free)
    stuck = np.diag(A) == 0  # what no camera observes
    A[stuck, stuck] = 1.0
    count = len(parameters.body_positions)
    V, body_gradient = np.zeros((count, size, size)), np.zeros((count, size))
    np.add.at(V, bundle.observations.body, np.einsum("m,mai,maj->mij", weight, by_body, by_body))
    np.add.at(body_gradient, bundle.observations.body, np.einsum("m,mai,ma->mi", weight, by_body, residuals))
    blocks = np.einsum("m,mai,maj->mij", weight, by_camera, by_body)
    rows = np.broadcast_to(columns[:, :, None], blocks.shape).ravel()
    bodies = size * bundle.observations.body[:, None, None] + np.arange(size)
    where = rows, np.broadcast_to(bodies, blocks.shape).ravel()
    W = csr_array((blocks.ravel(), where), shape=(total, count * size))
    return System(A, V, W, gradient, body_gradient)


def _derivatives(bundle: Bundle, parameters: Parameters) -> tuple[Floats, Floats, Indices]:
    """Of the misses by their camera's parameters ``[M, 2, 6 + F]`` and by their body's, and the former's unknowns."""
    own, (poses, _, _) = bundle.observations.camera, bundle.columns
    lens = bundle.lens[own]
    on_body, turned, local = bundle.in_cameras(parameters)
    by_point, by_row = derivatives(local, parameters.rows[lens], bundle.sizes[own], bundle.fisheye[own], bundle.free)
    by_camera = np.concatenate([by_point @ cross_matrices(-turned), by_point, by_row], 2)
    by_world = by_point @ parameters.rotations[own]
    by_body = np.concatenate([by_world @ cross_matrices(-on_body), by_world], 2) if bundle.rotating else by_world
    free = len(bundle.free)
    columns = np.concatenate([6 * own[:, None] + np.arange(6), poses + free * lens[:, None] + np.arange(free)], 1)
    return by_camera, by_body, columns


def _moved(bundle: Bundle, parameters: Parameters, step: Floats, body_step: Floats) -> Parameters:
    poses, lenses, _ = bundle.columns
    by_pose = step[:poses].reshape(-1, 6)
    rows = parameters.rows.copy()
    rows[:, bundle.free] += step[poses : poses + lenses].reshape(len(rows), -1)
    body_rotations = parameters.body_rotations
    if bundle.rotating:
        body_rotations = np.stack([*map(rotation_matrix, body_step[:, :3])]) @ body_rotations
    return replace(
        parameters,
        rotations=np.stack([*map(rotation_matrix, by_pose[:, :3])]) @ parameters.rotations,
        translations=parameters.translations + by_pose[:, 3:],
        rows=rows,
        body_rotations=body_rotations,
        body_positions=parameters.body_positions + body_step[:, -3:],
    )


MAX_PIXELS, MIN_DEGREES = 3.0, 1.5
"""Largest reprojection error, in pictures of 1000 pixels, and smallest angle between a point's rays."""
ROUNDS, STEPS, SAME = 8, 2, 0.05
NORMAL_MEDIAN = 1.1774  # of the length of a pair of standard normal numbers


def inlier_pixels(longest_side: int) -> float:
    """Largest reprojection error of what stays, and epipolar distance of a match that agrees, pixels: three of pictures
    of 1000 pixels on the longer side, in proportion, and never under one."""
    return max(1.0, MAX_PIXELS * longest_side / 1000)


def adjust_together(
    found: SolvedCalibration,
    *,
    lens: Sequence[int],
    free: Sequence[int],
    pixels: float,
    makes: Sequence[int] | None = None,
) -> SolvedCalibration:
    """``found`` with poses, points and the free terms (``lens_terms.py``) of its lenses adjusted, without the
    observations that are more than ``pixels`` off. ``lens`` has the number of the lens of each camera; cameras with
    shared intrinsics have one. Lenses of one picture size share a mean; with ``makes``, a number for each camera, those
    of one picture size and one number."""

    def adjusted(found: SolvedCalibration, parameters: Parameters) -> SolvedCalibration:
        cameras = cameras_in(parameters, found.cameras, bundle.lens)
        return cleaned(replace(found, cameras=cameras, points=parameters.body_positions), pixels=pixels)

    bundle, parameters = estimated(*_problem(found, np.asarray(lens, np.intp), tuple(free), makes))
    inliers = adjusted(found, parameters)
    again, parameters = _problem(inliers, bundle.lens, bundle.free, makes)
    return adjusted(inliers, solved(replace(again, prior=bundle.prior, noise=bundle.noise), parameters))


def cleaned(found: SolvedCalibration, *, pixels: float) -> SolvedCalibration:
    """Without observations that are further off, and without points whose rays then have too small an angle."""
    seen = found.observations
    with np.errstate(invalid="ignore"):
        good = found.errors() <= pixels
    wide = _angles(found, good) >= np.radians(MIN_DEGREES)
    return chosen(found, good & wide[seen.point])


def chosen(found: SolvedCalibration, good: NDArray[np.bool_]) -> SolvedCalibration:
    """With some of its observations ``[M]`` alone; points without any are left out."""
    seen = found.observations
    inliers, point = np.unique(seen.point[good], return_inverse=True)
    observations = Observations(point.astype(np.intp), seen.camera[good], seen.pixels[good], seen.instant[good])
    return replace(found, points=found.points[inliers], observations=observations)


def _problem(
    found: SolvedCalibration, lens: Indices, free: tuple[int, ...], makes: Sequence[int] | None
) -> tuple[Bundle, Parameters]:
    cameras, seen = list(found.cameras.values()), found.observations
    observations = BodyObservations(seen.camera, seen.point, np.zeros((len(seen), 3)), seen.pixels)
    bodies = np.broadcast_to(np.eye(3), (len(found.points), 3, 3)), found.points
    return posed_problem(cameras, observations, bodies, lens=lens, free=free, rotating=False, makes=makes)


def posed_problem(
    cameras: Sequence[LensCamera],
    observations: BodyObservations,
    bodies: tuple[Floats, Floats],
    *,
    lens: Indices,
    free: tuple[int, ...],
    rotating: bool,
    makes: Sequence[int] | None = None,
) -> tuple[Bundle, Parameters]:
    """The problem of cameras that see ``bodies``, rotations ``[B, 3, 3]`` and positions ``[B, 3]``, with the usual
    prior of their lenses."""
    _, first = np.unique(lens, return_index=True)
    rows = np.stack([row_of(cameras[index]) for index in first])
    sizes = np.array([[filmed.camera.width, filmed.camera.height] for filmed in cameras], np.float64)
    fisheye = np.array([isinstance(filmed.lens, Fisheye) for filmed in cameras])
    kinds = sizes if makes is None else np.column_stack([sizes, makes])
    _, alike = np.unique(kinds[first], axis=0, return_inverse=True)
    prior = usual_prior(alike.ravel(), free, fisheye=bool(fisheye.any()))
    views = np.stack([filmed.camera.viewmat.numpy() for filmed in cameras])
    bundle = Bundle(observations, lens, sizes, fisheye, free, rotating, prior)
    return bundle, Parameters(views[:, :3, :3], views[:, :3, 3], rows, *bodies)


def estimated(bundle: Bundle, parameters: Parameters) -> tuple[Bundle, Parameters]:
    """Adjusted, with the noise and the differences of lenses that fit best."""
    poses = bundle.columns[0]
    bundle = _with_noise(bundle, parameters)
    for _ in range(ROUNDS):
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


def cameras_in(parameters: Parameters, cameras: Mapping[str, LensCamera], lens: Indices) -> dict[str, LensCamera]:
    """``cameras`` with the poses and lenses of the parameters."""
    poses = map(rigid, parameters.rotations, parameters.translations)
    parts = zip(cameras.items(), parameters.rows[lens], poses, strict=True)
    return {name: with_row(filmed, row, viewmat) for (name, filmed), row, viewmat in parts}


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
