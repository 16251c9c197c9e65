# SPDX-License-Identifier: Apache-2.0
"""Plain Gaussians as in files of 3D Gaussian splatting: constant shape and opacity, direction-dependent colour.

Colours follow ``scene/harmonics.py``, Note [Spherical harmonics], with negative values set to 0.
"""

import math
from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor

from structgstream.cameras import Camera
from structgstream.gaussians import Gaussians
from structgstream.kernels.backend import Backend
from structgstream.scene.harmonics import sh_basis
from structgstream.similarity import Similarity

HALF_TURN_SIGNS = (1, -1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1)
"""Signs of the spherical harmonics up to degree 3 under half a turn around x."""


@dataclass(frozen=True)
class BakedGaussians:
    """``N`` Gaussians whose colour depends on the view direction.

    Args:
        means: ``[N, 3]``.
        quats: ``[N, 4]`` wxyz, unit length, ``w`` not negative.
        scales: ``[N, 3]`` standard deviations, in the unit of ``means``.
        opacities: ``[N]`` in (0, 1).
        sh: ``[N, (degree + 1)^2, 3]`` sRGB coefficients (``scene/harmonics.py``).
    """

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    sh: Tensor

    def __len__(self) -> int:
        return self.means.shape[0]

    @property
    def degree(self) -> int:
        """Degree of the spherical harmonics."""
        return math.isqrt(self.sh.shape[1]) - 1

    def select(self, rows: Tensor) -> "BakedGaussians":
        """The rows of a mask ``[N]`` or of indices ``[n]``, in order of the indices."""
        return BakedGaussians(**{f.name: getattr(self, f.name)[rows] for f in fields(self)})

    def to(self, device: torch.device) -> "BakedGaussians":
        """The same on ``device``."""
        return BakedGaussians(**{f.name: getattr(self, f.name).to(device) for f in fields(self)})

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
