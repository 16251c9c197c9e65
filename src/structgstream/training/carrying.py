# SPDX-License-Identifier: Apache-2.0
"""Hidden anchors are carried along by what moves beside them.

Some anchors are shown by no view, or by too few to vote: those within a body, behind its rim, or below its surface, up
to a fifth of all. If they stayed where they are while the body leaves, they would hang in the air as specks as soon as
nothing covers them, and then nothing there changes any more. What is beside them tells where they belong.
"""

import torch
from torch import Tensor

from structgstream.training.neighbours import nearest

NEIGHBOURS = 8
"""Number of nearest shown anchors that a hidden one is compared with."""


def carried_anchors(positions: Tensor, moving: Tensor, shown: Tensor, *, share: float) -> Tensor:
    """Mask ``[M]`` of the hidden anchors of whose nearest shown ones at least ``share`` move.

    Args:
        positions: ``[M, 3]`` scene units.
        moving: mask ``[M]`` of the anchors that move by their own votes.
        shown: mask ``[M]`` of the anchors that enough views show to tell; the others are hidden.
        share: 0 to 1; 0: none is carried.

    Raises:
        MissingExtraError: SciPy is not installed.
    """
    carried = torch.zeros_like(moving)
    hidden, known = (mask.nonzero()[:, 0] for mask in (~moving & ~shown, shown))
    if share == 0.0 or not len(hidden) or not moving.any() or not len(known):
        return carried
    near, _ = nearest(positions[hidden], positions[known], NEIGHBOURS)
    carried[hidden] = moving[known[near]].float().mean(1) >= share
    return carried
