# SPDX-License-Identifier: Apache-2.0
"""An order of anchors in which neighbours in space are neighbours in memory and in a stream."""

from dataclasses import replace

import torch
from torch import Tensor

from structgstream.scene.scene import Scene

_BITS = 20


def space_order(positions: Tensor) -> Tensor:
    """Rows ``[M]`` of ``positions`` ``[M, 3]`` along a Z-order curve through their bounding cube (Morton, 1966)."""
    if not len(positions):
        return torch.zeros(0, dtype=torch.int64, device=positions.device)
    low = positions.min(0).values
    extent = (positions.max(0).values - low).max().clamp(min=1e-30)
    cells = ((positions - low) / extent * (2**_BITS - 1)).to(torch.int64)
    keys = torch.zeros(len(positions), dtype=torch.int64, device=positions.device)
    for bit in range(_BITS):
        for axis in range(3):
            keys |= ((cells[:, axis] >> bit) & 1) << (3 * bit + axis)
    return keys.argsort(stable=True)


def in_space_order(scene: Scene) -> Scene:
    """The same scene, its anchors in :func:`space_order`. It must have no free Gaussians, whose ids would change."""
    assert not len(scene.free), "ids of free Gaussians follow those of anchors"
    order = space_order(scene.anchors.positions)
    return replace(scene, anchors=scene.anchors.select(order))
