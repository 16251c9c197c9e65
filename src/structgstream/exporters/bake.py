# SPDX-License-Identifier: Apache-2.0
"""Bakes a scene, whose Gaussians depend on the camera, into plain Gaussians.

Note [Baking]
~~~~~~~~~~~~~
The MLPs compute a structured Gaussian's opacity, shape and colour for one camera; its mean is the same for all cameras.
A plain Gaussian has one opacity and one shape: averages over the training cameras, matched by id. Its colour is a
least-squares fit of spherical harmonics to the colours for these cameras. A ridge term shrinks all coefficients except
the constant one, because a dozen cameras on one side hardly constrain the other directions. ``docs/export.md`` has the
measurements behind the defaults of :class:`BakingConfig`.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor

from structgstream.cameras import Camera
from structgstream.errors import StreamError
from structgstream.exporters.baked_gaussians import BakedGaussians
from structgstream.gaussians import Gaussians
from structgstream.geometry import quaternion_matrices
from structgstream.kernels.backend import Backend
from structgstream.scene.harmonics import sh_basis
from structgstream.scene.render import draw
from structgstream.scene.sampling import RigSampling
from structgstream.scene.scene import Scene

MIN_OPACITY = 1.0 / 255.0
"""Opacity below which a rasteriser does not draw a Gaussian."""


@dataclass(frozen=True)
class BakingConfig:
    """Configuration of baking.

    Args:
        degree: degree of the spherical harmonics, 0 to 2.
        ridge: weight of the squares of all coefficients except the constant one, relative to the mean squared error.
        opacity: ``seen`` averages over the cameras with the anchor in view, with 0 for those that do not draw the
            Gaussian; ``drawn`` over the cameras that draw it.
        shape: ``parts`` averages log scales, and sign-aligned quaternions; ``covariance`` averages covariances.
        weight: weight of a camera for colour and shape: the Gaussian's ``opacity`` there, or its ``blend`` weight,
            summed over the picture, which accounts for occlusion.
    """

    degree: int = 1
    ridge: float = 1e-4
    opacity: Literal["seen", "drawn"] = "seen"
    shape: Literal["parts", "covariance"] = "parts"
    weight: Literal["opacity", "blend"] = "opacity"


def bake(
    scene: Scene, cameras: Iterable[Camera], backend: Backend, *, baking: BakingConfig | None = None
) -> BakedGaussians:
    """Plain Gaussians that approximate ``scene`` as seen from ``cameras`` and between them (Note [Baking]).

    Args:
        scene: the scene, on the device of ``backend``.
        cameras: the training cameras of the stream, in the scene's units.
        backend: the compute back-end.
        baking: the configuration; the default when None.

    Returns:
        Gaussians in the scene's units, in the order of ids, without invisible ones.

    Raises:
        StreamError: no camera draws any Gaussian.
    """
    baking = baking or BakingConfig()
    anchors = scene.anchors
    sums = _Sums(anchors.offsets.shape[0] * anchors.offsets_per_anchor + len(scene.free), anchors.positions, baking)
    with torch.no_grad():
        for camera in cameras:
            generated = scene.structured(camera, backend)
            slots = generated.anchors[:, None] * anchors.offsets_per_anchor
            slots = (slots + torch.arange(anchors.offsets_per_anchor, device=slots.device)).flatten()
            free = torch.arange(sums.seen.shape[0] - len(scene.free), sums.seen.shape[0], device=slots.device)
            sums.add(scene.with_free_gaussians(generated), camera, backend, seen=torch.cat([slots, free]))
        return sums.result()


def with_low_pass(gaussians: BakedGaussians, sampling: RigSampling, variance: float) -> BakedGaussians:
    """``gaussians`` widened by ``variance`` squared sampling intervals (``scene/sampling.py``).

    A viewer that draws larger pictures than the training pictures needs this, because its low-pass is that of its own,
    smaller pixels.

    Args:
        gaussians: the Gaussians, in the scene's units.
        sampling: sampling by the scene's training cameras.
        variance: squared training pixels, at least 0; scenes are trained with 0.3.
    """
    intervals = sampling.intervals(gaussians.means)
    return replace(gaussians, scales=(gaussians.scales**2 + variance * intervals[:, None] ** 2).sqrt())


def blend_weights(gaussians: Gaussians, camera: Camera, backend: Backend) -> Tensor:
    """Sum ``[N]`` of each Gaussian's blending weights over the picture, in pixels."""
    colors = torch.zeros_like(gaussians.colors, requires_grad=True)
    shown = replace(gaussians, colors=colors)
    with torch.enable_grad():
        image = draw(shown, camera, backend).image[..., 0]
        (gradient,) = torch.autograd.grad(image.sum(), colors)
    return gradient[:, 0]


class _Sums:
    """Sums over cameras, one row per Gaussian id."""

    def __init__(self, count: int, like: Tensor, baking: BakingConfig) -> None:
        terms = (baking.degree + 1) ** 2
        self.baking = baking
        self.means, self.weight = like.new_zeros(count, 3), like.new_zeros(count)
        self.seen, self.drawn, self.opacity = like.new_zeros(count), like.new_zeros(count), like.new_zeros(count)
        self.log_scales, self.quats = like.new_zeros(count, 3), like.new_zeros(count, 4)
        self.covariance = like.new_zeros(count, 3, 3) if baking.shape == "covariance" else None
        self.normal, self.right = like.new_zeros(count, terms, terms), like.new_zeros(count, terms, 3)

    def add(self, gaussians: Gaussians, camera: Camera, backend: Backend, *, seen: Tensor) -> None:
        """Adds one camera's Gaussians; ``seen`` are the ids of all Gaussians of its visible anchors."""
        ids = gaussians.ids
        self.seen[seen] += 1.0
        self.drawn[ids] += 1.0
        self.opacity[ids] += gaussians.opacities
        self.means[ids] = gaussians.means
        weight = gaussians.opacities
        if self.baking.weight == "blend":
            # A Gaussian that is occluded in all cameras still needs a shape and a colour.
            weight = blend_weights(gaussians, camera, backend) + 1e-3 * weight
        self.weight[ids] += weight
        self._add_shapes(gaussians, weight)
        center = camera.viewport(gaussians.means).center
        basis = sh_basis(torch.nn.functional.normalize(gaussians.means - center, dim=1), self.baking.degree)
        weighted = basis * weight[:, None]
        self.normal[ids] += weighted[:, :, None] * basis[:, None, :]
        self.right[ids] += weighted[:, :, None] * (gaussians.colors - 0.5)[:, None, :]

    def _add_shapes(self, gaussians: Gaussians, weight: Tensor) -> None:
        ids = gaussians.ids
        quats = torch.nn.functional.normalize(gaussians.quats, dim=1)
        if self.covariance is not None:
            axes = quaternion_matrices(quats) * gaussians.scales[:, None, :]
            self.covariance[ids] += weight[:, None, None] * (axes @ axes.transpose(1, 2))
            return
        self.log_scales[ids] += weight[:, None] * gaussians.scales.log()
        before = self.quats[ids]
        # A quaternion and its negative are the same rotation; the sign that agrees with the sum so far is used.
        side = torch.where((before * quats).sum(1, keepdim=True) < 0.0, -1.0, 1.0)
        self.quats[ids] = before + weight[:, None] * side * quats

    def result(self) -> BakedGaussians:
        """The averages and the fit."""
        counted = self.seen if self.baking.opacity == "seen" else self.drawn
        opacities = self.opacity / counted.clamp(min=1.0)
        rows = torch.nonzero((self.drawn > 0) & (self.weight > 0) & (opacities >= MIN_OPACITY))[:, 0]
        if not len(rows):
            raise StreamError("No training camera sees any Gaussian of the scene, so there is nothing to export.")
        weight = self.weight[rows]
        quats, scales = self._shapes(rows)
        return BakedGaussians(
            means=self.means[rows],
            quats=torch.where(quats[:, :1] < 0.0, -quats, quats),
            scales=scales,
            opacities=opacities[rows],
            sh=self._coefficients(rows, weight),
        )

    def _shapes(self, rows: Tensor) -> tuple[Tensor, Tensor]:
        weight = self.weight[rows, None]
        if self.covariance is None:
            return torch.nn.functional.normalize(self.quats[rows], dim=1), (self.log_scales[rows] / weight).exp()
        variances, axes = torch.linalg.eigh((self.covariance[rows] / weight[..., None]).double())
        axes = axes * torch.linalg.det(axes)[:, None, None]  # a rotation, not a reflection: three axes change sign
        return matrix_quaternions(axes).to(weight.dtype), variances.clamp(min=1e-14).sqrt().to(weight.dtype)

    def _coefficients(self, rows: Tensor, weight: Tensor) -> Tensor:
        terms = self.normal.shape[1]
        penalty = torch.full((terms,), self.baking.ridge, dtype=torch.float64, device=weight.device)
        penalty[0] = 0.0
        normal = self.normal[rows].double() / weight[:, None, None].double() + torch.diag(penalty)
        right = self.right[rows].double() / weight[:, None, None].double()
        return torch.linalg.solve(normal, right).to(weight.dtype)


def matrix_quaternions(matrices: Tensor) -> Tensor:
    """Unit quaternions ``[N, 4]`` wxyz of rotation matrices ``[N, 3, 3]``, from the largest of four pivots."""
    m = matrices
    diagonal = m.diagonal(dim1=1, dim2=2)
    x, y, z = diagonal.unbind(1)
    squares = torch.stack([1 + x + y + z, 1 + x - y - z, 1 - x + y - z, 1 - x - y + z], dim=1)
    wx, wy, wz = m[:, 2, 1] - m[:, 1, 2], m[:, 0, 2] - m[:, 2, 0], m[:, 1, 0] - m[:, 0, 1]
    xy, xz, yz = m[:, 1, 0] + m[:, 0, 1], m[:, 0, 2] + m[:, 2, 0], m[:, 2, 1] + m[:, 1, 2]
    products = torch.stack(
        [
            torch.stack([squares[:, 0], wx, wy, wz], dim=1),
            torch.stack([wx, squares[:, 1], xy, xz], dim=1),
            torch.stack([wy, xy, squares[:, 2], yz], dim=1),
            torch.stack([wz, xz, yz, squares[:, 3]], dim=1),
        ],
        dim=1,
    )
    best = squares.argmax(1)
    return torch.nn.functional.normalize(products[torch.arange(len(m), device=m.device), best], dim=1)
