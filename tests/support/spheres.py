# SPDX-License-Identifier: Apache-2.0
"""Directions that cover the sphere evenly."""

import torch


def fibonacci_sphere(count: int) -> torch.Tensor:
    """Unit directions ``[count, 3]``, float64 (Fibonacci's lattice)."""
    z = 1.0 - (2.0 * torch.arange(count, dtype=torch.float64) + 1.0) / count
    angle = torch.pi * (3.0 - 5.0**0.5) * torch.arange(count, dtype=torch.float64)
    ring = (1.0 - z * z).sqrt()
    return torch.stack([ring * angle.cos(), ring * angle.sin(), z], dim=1)
