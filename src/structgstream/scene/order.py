# SPDX-License-Identifier: Apache-2.0
"""An order of anchors in which neighbours in space are neighbours in memory and in a stream (Morton, 1966)."""

from dataclasses import replace

import torch
from torch import Tensor

from structgstream.scene.scene import Scene

CELL_BITS = 20
"""Of a cell's place along an axis."""


def morton_keys(cells: Tensor) -> Tensor:
    """Places int64 ``[M]`` of cells int64 ``[M, 3]``, from 0 to below 2^20, on a Z-order curve; x changes fastest."""
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
    """Rows ``[M]`` of ``positions`` ``[M, 3]`` along a Z-order curve, those of one cell as they stood.

    Args:
        positions: in units of the scene.
        step: side of a cell, the nearest multiples of it being the cells' middles; None takes a 2^20th of the
            bounding cube, and so does a step that is smaller.
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
    """The same scene, its anchors in :func:`morton_order`. It must have no free Gaussians, whose ids would change."""
    assert not len(scene.free), "ids of free Gaussians follow those of anchors"
    order = morton_order(scene.anchors.positions, step=step)
    return replace(scene, anchors=scene.anchors.select(order))
