# SPDX-License-Identifier: Apache-2.0
"""Real spherical harmonics of low degree, for direction-dependent colours.

Note [Spherical harmonics]
~~~~~~~~~~~~~~~~~~~~~~~~~~
A colour is ``0.5 + sum Y_i c_i``. ``Y_i`` are the orthonormal real spherical harmonics with the Condon-Shortley phase,
evaluated at a unit direction away from the camera and ordered by degree ``l``, then by order ``m`` from ``-l`` to
``l``. This is the convention of the files of 3D Gaussian splatting (Kerbl et al., 2023).
"""

import math

import torch
from torch import Tensor

Y0 = 0.5 / math.sqrt(math.pi)
MAX_DEGREE = 3


def sh_basis(directions: Tensor, degree: int) -> Tensor:
    """Real spherical harmonics ``[..., (degree + 1)^2]`` of unit ``directions`` ``[..., 3]`` up to ``degree`` <= 3."""
    x, y, z = directions.unbind(-1)
    found = [torch.full_like(x, Y0)]
    if degree >= 1:
        a = math.sqrt(3.0 / (4.0 * math.pi))
        found += [-a * y, a * z, -a * x]
    if degree >= 2:
        a, b = math.sqrt(15.0 / (4.0 * math.pi)), math.sqrt(5.0 / (16.0 * math.pi))
        found += [a * x * y, -a * y * z, b * (3.0 * z * z - 1.0), -a * x * z, 0.5 * a * (x * x - y * y)]
    if degree >= 3:
        a, b = math.sqrt(35.0 / (32.0 * math.pi)), math.sqrt(21.0 / (32.0 * math.pi))
        c, d = math.sqrt(105.0 / (4.0 * math.pi)), math.sqrt(7.0 / (16.0 * math.pi))
        found += [
            -a * y * (3.0 * x * x - y * y),
            c * x * y * z,
            -b * y * (5.0 * z * z - 1.0),
            d * z * (5.0 * z * z - 3.0),
            -b * x * (5.0 * z * z - 1.0),
            0.5 * c * z * (x * x - y * y),
            -a * x * (x * x - 3.0 * y * y),
        ]
    return torch.stack(found, dim=-1)
