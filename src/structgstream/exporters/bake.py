# SPDX-License-Identifier: Apache-2.0
"""Plain Gaussians, as files of 3D Gaussian splatting have them, and how a scene is baked to them.

A plain Gaussian has constant shape and opacity, and a direction-dependent colour (``harmonics.py``, Note
[Spherical harmonics]), with negative values set to 0.

Note [Baking]
~~~~~~~~~~~~~
The MLPs compute a structured Gaussian's opacity, shape and colour for one camera; its mean is the same for all cameras.
A plain Gaussian has one opacity and one shape: averages over the training cameras, matched by id. Its colour is a
least-squares fit of spherical harmonics to the colours for these cameras. A ridge term shrinks all coefficients except
the constant one, because a dozen cameras on one side hardly constrain the other directions.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor

from structgstream.cameras import Camera, Similarity
from structgstream.errors import StreamError
from structgstream.gaussians import Gaussians
from structgstream.harmonics import sh_basis
from structgstream.kernels.backend import Backend
from structgstream.scene.sampling import RigSampling
from structgstream.scene.scene import Scene

HALF_TURN_SIGNS = (1, -1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1)
"""Signs of the spherical harmonics up to degree 3 under half a turn around x."""


@dataclass(frozen=True)
class BakedGaussians:
    """``N`` Gaussians whose colour depends on the view direction."""

    means: Tensor  # [N, 3]
    quats: Tensor  # [N, 4] wxyz, unit length; baked ones have w >= 0, those of a read .ply any sign
    scales: Tensor  # [N, 3] standard deviations, in the unit of means
    opacities: Tensor  # [N] in (0, 1)
    sh: Tensor  # [N, (degree + 1)^2, 3] sRGB coefficients (harmonics.py)

    def __len__(self) -> int:
        return self.means.shape[0]

    @property
    def degree(self) -> int:
        """Degree of the spherical harmonics."""
        return math.isqrt(self.sh.shape[1]) - 1

    def select(self, rows: Tensor) -> "BakedGaussians":
        """The rows of a mask ``[N]`` or of indices ``[n]``, in order of the indices."""
        return BakedGaussians(**{f.name: getattr(self, f.name)[rows] for f in fields(self)})

    def colors(self, center: Tensor) -> Tensor:
        """sRGB colours ``[N, 3]`` seen from ``center`` ``[3]``."""
        basis = sh_basis(torch.nn.functional.normalize(self.means - center, dim=1), self.degree)
        return (0.5 + torch.einsum("ns,nsc->nc", basis, self.sh)).clamp(min=0.0)

    def gaussians(self, camera: Camera, backend: Backend) -> Gaussians:
        """The Gaussians with their colours for ``camera``. ``backend`` is not used (``Drawable`` protocol)."""
        return Gaussians(
            means=self.means,
            quats=self.quats,
            scales=self.scales,
            opacities=self.opacities,
            colors=self.colors(camera.viewport(self.means).center),
            ids=torch.arange(len(self), device=self.means.device),
        )

    def in_capture_units(self, similarity: Similarity) -> "BakedGaussians":
        """The same Gaussians in the capture's units; axes do not change, because a similarity has no rotation."""
        means = similarity.inverse_points(self.means.cpu().double()).to(self.means)
        return replace(self, means=means, scales=self.scales / similarity.scale)

    def y_up(self) -> "BakedGaussians":
        """The same Gaussians with y up and z back instead of y down and z forward: half a turn around x."""
        signs = self.sh.new_tensor(HALF_TURN_SIGNS[: self.sh.shape[1]])
        return replace(
            self,
            means=self.means * self.means.new_tensor((1.0, -1.0, -1.0)),
            quats=self.quats * self.quats.new_tensor((1.0, 1.0, -1.0, -1.0)),
            sh=self.sh * signs[:, None],
        )

    def by_importance(self) -> Tensor:
        """Indices ``[N]`` by volume times opacity, largest first."""
        importance = self.scales.log().sum(1) + self.opacities.log()
        return importance.argsort(descending=True, stable=True)


MIN_OPACITY = 1.0 / 255.0
"""Opacity below which a rasteriser does not draw a Gaussian."""


RIDGE = 1e-4
"""Weight of the squares of all coefficients except the constant one, relative to the mean squared error."""


def bake(scene: Scene, cameras: Iterable[Camera], backend: Backend, *, degree: int = 1) -> BakedGaussians:
    """Plain Gaussians that approximate ``scene`` as seen from ``cameras`` and between them (Note [Baking]).

    Args:
        cameras: the training cameras of the stream, in the scene's units.

    Returns:
        Gaussians in the scene's units, in the order of ids, without invisible ones.

    Raises:
        StreamError: no camera draws any Gaussian.
    """
    anchors = scene.anchors
    sums = _Sums(anchors.offsets.shape[0] * anchors.offsets_per_anchor + len(scene.free), anchors.positions, degree)
    with torch.no_grad():
        for camera in cameras:
            generated = scene.structured(camera, backend)
            slots = generated.anchors[:, None] * anchors.offsets_per_anchor
            slots = (slots + torch.arange(anchors.offsets_per_anchor, device=slots.device)).flatten()
            free = torch.arange(sums.seen.shape[0] - len(scene.free), sums.seen.shape[0], device=slots.device)
            sums.add(scene.with_free_gaussians(generated), camera, seen=torch.cat([slots, free]))
        return sums.result()


def with_low_pass(gaussians: BakedGaussians, sampling: RigSampling, variance: float) -> BakedGaussians:
    """``gaussians`` widened by ``variance`` squared sampling intervals (``scene/sampling.py``), in squared training
    pixels.

    A viewer that draws larger pictures than the training pictures needs this, because its low-pass is that of its own,
    smaller pixels. Scenes are trained with 0.3.
    """
    intervals = sampling.intervals(gaussians.means)
    return replace(gaussians, scales=(gaussians.scales**2 + variance * intervals[:, None] ** 2).sqrt())


class _Sums:
    """Sums over cameras, one row per Gaussian id."""

    def __init__(self, count: int, like: Tensor, degree: int) -> None:
        terms = (degree + 1) ** 2
        self.degree = degree
        self.means, self.seen, self.weight = like.new_zeros(count, 3), like.new_zeros(count), like.new_zeros(count)
        self.log_scales, self.quats = like.new_zeros(count, 3), like.new_zeros(count, 4)
        self.normal, self.right = like.new_zeros(count, terms, terms), like.new_zeros(count, terms, 3)

    def add(self, gaussians: Gaussians, camera: Camera, *, seen: Tensor) -> None:
        """Adds one camera's Gaussians; ``seen`` are the ids of all Gaussians of its visible anchors."""
        ids, weight = gaussians.ids, gaussians.opacities
        self.seen[seen] += 1.0
        self.weight[ids] += weight
        self.means[ids] = gaussians.means
        quats = torch.nn.functional.normalize(gaussians.quats, dim=1)
        self.log_scales[ids] += weight[:, None] * gaussians.scales.log()
        before = self.quats[ids]
        # A quaternion and its negative are the same rotation; the sign that agrees with the sum so far is used.
        side = torch.where((before * quats).sum(1, keepdim=True) < 0.0, -1.0, 1.0)
        self.quats[ids] = before + weight[:, None] * side * quats
        center = camera.viewport(gaussians.means).center
        basis = sh_basis(torch.nn.functional.normalize(gaussians.means - center, dim=1), self.degree)
        weighted = basis * weight[:, None]
        self.normal[ids] += weighted[:, :, None] * basis[:, None, :]
        self.right[ids] += weighted[:, :, None] * (gaussians.colors - 0.5)[:, None, :]

    def result(self) -> BakedGaussians:
        """The averages and the fit."""
        opacities = self.weight / self.seen.clamp(min=1.0)
        rows = torch.nonzero(opacities >= MIN_OPACITY)[:, 0]
        if not len(rows):
            raise StreamError("No training camera sees any Gaussian of the scene, so there is nothing to export.")
        weight = self.weight[rows]
        quats = torch.nn.functional.normalize(self.quats[rows], dim=1)
        return BakedGaussians(
            means=self.means[rows],
            quats=torch.where(quats[:, :1] < 0.0, -quats, quats),
            scales=(self.log_scales[rows] / weight[:, None]).exp(),
            opacities=opacities[rows],
            sh=self._coefficients(rows, weight),
        )

    def _coefficients(self, rows: Tensor, weight: Tensor) -> Tensor:
        terms = self.normal.shape[1]
        penalty = torch.full((terms,), RIDGE, dtype=torch.float64, device=weight.device)
        penalty[0] = 0.0
        normal = self.normal[rows].double() / weight[:, None, None].double() + torch.diag(penalty)
        right = self.right[rows].double() / weight[:, None, None].double()
        return torch.linalg.solve(normal, right).to(weight.dtype)
