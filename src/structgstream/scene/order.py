# SPDX-License-Identifier: Apache-2.0
"""Z-order (Morton, 1966) of anchors: neighbours in space are close in memory and in the stream."""

from dataclasses import replace

import torch
from torch import Tensor

from structgstream.scene.scene import Scene

CELL_BITS = 20
"""Bits of a cell's coordinate along one axis."""


def morton_keys(cells: Tensor) -> Tensor:
    """Z-order keys int64 ``[M]`` of cells int64 ``[M, 3]`` with coordinates in 0 ... 2^20 - 1; x is the lowest bit."""
    keys = torch.zeros(len(cells), dtype=torch.int64, device=cells.device)
    for bit in range(CELL_BITS):
        for axis in range(3):
            keys |= ((cells[:, axis] >> bit) & 1) << (3 * bit + axis)
    return keys


def morton_cells(keys: Tensor) -> Tensor:
    """The inverse of :func:`morton_keys`."""
    cells = torch.zeros(len(keys), 3, dtype=torch.int64, device=keys.device)
    for bit in range(CELL_BITS):
        for axis in range(3):
            cells[:, axis] |= ((keys >> (3 * bit + axis)) & 1) << bit
    return cells


def morton_order(positions: Tensor, *, step: float | None = None) -> Tensor:
    """Row indices ``[M]`` that sort ``positions`` ``[M, 3]`` along a Z-order curve; stable within a cell.

    Args:
        positions: in units of the scene.
        step: side of a cell, whose centre is a multiple of it. None, or a step too small for 2^20 cells along the
            longest axis, divides the bounding cube into 2^20 cells along each axis.
    """
    if not len(positions):
        return torch.zeros(0, dtype=torch.int64, device=positions.device)
    low = positions.min(0).values
    extent = (positions.max(0).values - low).max().clamp(min=1e-30)
    if step is None or not extent / step < 2**CELL_BITS - 2:
        cells = ((positions - low) / extent * (2**CELL_BITS - 1)).to(torch.int64)
    else:
        cells = (positions.double() / step).round().to(torch.int64)
        cells -= cells.min(0).values
    return morton_keys(cells).argsort(stable=True)


def in_morton_order(scene: Scene, *, step: float | None = None) -> Scene:
    """``scene`` with its anchors in :func:`morton_order`. It must not have free Gaussians, because ids would change."""
    assert not len(scene.free), "ids of free Gaussians follow those of anchors"
    order = morton_order(scene.anchors.positions, step=step)
    return replace(scene, anchors=scene.anchors.select(order))
