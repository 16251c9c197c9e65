# SPDX-License-Identifier: Apache-2.0
"""Gaussians as 3D Gaussian splatting has them: each with parameters of its own, and a colour that depends on direction.

A colour is ``0.5 + Y_0 c_0 + sum Y_i c_i``, from below cut off at 0, with the ``Y`` of ``structgstream/harmonics.py``
in the direction from the camera to the Gaussian's mean.
"""

import math
from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor

from structgstream.cameras import Camera
from structgstream.gaussians import Gaussians
from structgstream.harmonics import Y0, sh_basis
from structgstream.kernels.backend import Backend

MAX_DEGREE = 2


def degree_of(coefficients: int) -> int:
    """The degree with this many coefficients above order 0."""
    return math.isqrt(coefficients + 1) - 1


@dataclass(frozen=True)
class PlainGaussians:
    """Gaussians before activation.

    Args:
        means: ``[N, 3]`` scene units.
        log_scales: ``[N, 3]`` logarithms of standard deviations.
        quats: ``[N, 4]`` wxyz, of any length.
        logit_opacities: ``[N]``.
        base_colors: ``[N, 3]`` coefficients of order 0.
        sh: ``[N, (degree + 1)^2 - 1, 3]`` the others.
    """

    means: Tensor
    log_scales: Tensor
    quats: Tensor
    logit_opacities: Tensor
    base_colors: Tensor
    sh: Tensor

    def __len__(self) -> int:
        return self.means.shape[0]

    @classmethod
    def empty(cls, degree: int, like: Tensor) -> "PlainGaussians":
        """No Gaussians."""
        shapes = ((0, 3), (0, 3), (0, 4), (0,), (0, 3), (0, (degree + 1) ** 2 - 1, 3))
        return cls(*(like.new_zeros(shape) for shape in shapes))

    @property
    def degree(self) -> int:
        """Degree of the spherical harmonics."""
        return degree_of(self.sh.shape[1])

    def tensors(self) -> dict[str, Tensor]:
        """Every tensor by name."""
        return {f.name: getattr(self, f.name) for f in fields(self)}

    def select(self, rows: Tensor) -> "PlainGaussians":
        """The rows that a mask ``[N]`` or an index ``[n]`` names."""
        return PlainGaussians(**{name: value[rows] for name, value in self.tensors().items()})

    def joined(self, other: "PlainGaussians") -> "PlainGaussians":
        """Both sets in one."""
        return PlainGaussians(
            **{name: torch.cat([value, getattr(other, name)]) for name, value in self.tensors().items()}
        )

    def on_device(self, device: torch.device) -> "PlainGaussians":
        """The same with its tensors on ``device``."""
        return PlainGaussians(**{name: value.to(device) for name, value in self.tensors().items()})

    def detached(self) -> "PlainGaussians":
        """The same without a gradient graph."""
        return PlainGaussians(**{name: value.detach() for name, value in self.tensors().items()})

    def colors(self, center: Tensor, *, degree: int | None = None) -> Tensor:
        """Colours ``[N, 3]`` seen from ``center`` ``[3]``; orders above ``degree`` count as zero."""
        colors = 0.5 + Y0 * self.base_colors
        used = self.degree if degree is None else min(degree, self.degree)
        if used:
            basis = sh_basis(torch.nn.functional.normalize(self.means - center, dim=1), used)[:, 1:]
            colors = colors + (basis[:, :, None] * self.sh[:, : basis.shape[1]]).sum(1)
        return colors.clamp(min=0.0)

    def gaussians(self, camera: Camera, backend: Backend, *, degree: int | None = None) -> Gaussians:
        """What ``camera`` sees. The back-end is not needed: it is part of what a drawable is."""
        return Gaussians(
            means=self.means,
            quats=self.quats,
            scales=self.log_scales.exp(),
            opacities=self.logit_opacities.sigmoid(),
            colors=self.colors(camera.viewport(self.means).center, degree=degree),
            ids=torch.arange(len(self), device=self.means.device),
        )


def rotated(quats: Tensor, vectors: Tensor) -> Tensor:
    """``vectors`` ``[N, 3]`` turned by ``quats`` ``[N, 4]`` (wxyz, of any length)."""
    unit = torch.nn.functional.normalize(quats, dim=1)
    twice = 2.0 * torch.linalg.cross(unit[:, 1:], vectors)
    return vectors + unit[:, :1] * twice + torch.linalg.cross(unit[:, 1:], twice)


def composed(first: Tensor, second: Tensor) -> Tensor:
    """The quaternions ``[N, 4]`` (wxyz) of turning by ``second``, then by ``first``."""
    w, v = first[:, :1], first[:, 1:]
    other_w, other_v = second[:, :1], second[:, 1:]
    scalar = w * other_w - (v * other_v).sum(1, keepdim=True)
    return torch.cat([scalar, w * other_v + other_w * v + torch.linalg.cross(v, other_v)], dim=1)


def moved(gaussians: PlainGaussians, shifts: Tensor, turns: Tensor) -> PlainGaussians:
    """Means shifted by ``shifts`` ``[N, 3]``, rotations turned by ``turns`` ``[N, 4]``; colours as they were."""
    normalised = torch.nn.functional.normalize
    quats = composed(normalised(turns, dim=1), normalised(gaussians.quats, dim=1))
    return replace(gaussians, means=gaussians.means + shifts, quats=quats)
