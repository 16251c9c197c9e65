# SPDX-License-Identifier: Apache-2.0
import torch

from structgstream.geometry import quaternion_matrices


def test_matrices_are_rotations() -> None:
    matrices = quaternion_matrices(torch.randn(50, 4, dtype=torch.float64) * 3)
    identity = torch.eye(3, dtype=torch.float64).expand(50, 3, 3)
    assert torch.allclose(matrices @ matrices.transpose(1, 2), identity)
    assert torch.allclose(torch.linalg.det(matrices), torch.ones(50, dtype=torch.float64))


def test_quarter_turn_about_z() -> None:
    half = 0.5**0.5
    matrix = quaternion_matrices(torch.tensor([half, 0.0, 0.0, half]))
    assert torch.allclose(matrix @ torch.tensor([1.0, 0.0, 0.0]), torch.tensor([0.0, 1.0, 0.0]), atol=1e-6)


def test_composition_matches_the_hamilton_product() -> None:
    a, b = torch.randn(2, 4, dtype=torch.float64)
    w = a[0] * b[0] - a[1:] @ b[1:]
    product = torch.cat([w[None], a[0] * b[1:] + b[0] * a[1:] + torch.linalg.cross(a[1:], b[1:])])
    assert torch.allclose(quaternion_matrices(product), quaternion_matrices(a) @ quaternion_matrices(b))
