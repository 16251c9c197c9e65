# SPDX-License-Identifier: Apache-2.0
"""The real spherical harmonics, by their integrals over the sphere and by hand along the axes."""

import math

import torch

from structgstream.harmonics import MAX_DEGREE, Y0, sh_basis
from tests.support.spheres import fibonacci_sphere


def test_the_harmonics_are_orthonormal() -> None:
    basis = sh_basis(fibonacci_sphere(80_000), MAX_DEGREE)
    products = basis.T @ basis * (4.0 * torch.pi / len(basis))
    torch.testing.assert_close(products, torch.eye((MAX_DEGREE + 1) ** 2, dtype=torch.float64), atol=1e-6, rtol=0)


def test_a_lower_degree_is_the_beginning_of_a_higher_one() -> None:
    directions = fibonacci_sphere(20).reshape(4, 5, 3)
    whole = sh_basis(directions, MAX_DEGREE)
    assert whole.shape == (4, 5, (MAX_DEGREE + 1) ** 2)
    for degree in range(MAX_DEGREE):
        assert torch.equal(sh_basis(directions, degree), whole[..., : (degree + 1) ** 2])


def test_along_the_axes_by_hand() -> None:
    """Order by order, with the Condon-Shortley phase: -y, z, -x; xy, -yz, 3 z^2 - 1, -xz, x^2 - y^2."""
    a, b, c = (math.sqrt(n / math.pi) for n in (3 / 4, 5 / 16, 15 / 16))
    found = sh_basis(torch.eye(3), 2)
    expected = [
        [Y0, 0.0, 0.0, -a, 0.0, 0.0, -b, 0.0, c],
        [Y0, -a, 0.0, 0.0, 0.0, 0.0, -b, 0.0, -c],
        [Y0, 0.0, a, 0.0, 0.0, 0.0, 2.0 * b, 0.0, 0.0],
    ]
    torch.testing.assert_close(found, torch.tensor(expected))
