# SPDX-License-Identifier: Apache-2.0
"""Partial rendering: only the tiles that dynamic Gaussians reach are drawn."""

from dataclasses import dataclass

from torch import Tensor

from structgstream.gaussians import Gaussians
from structgstream.kernels.values import TileSelection


@dataclass(frozen=True)
class ActiveTiles:
    """The tiles of one camera's picture that optimisation can change.

    Drawing in them gives the pixels of a full rendering in these tiles, as long as the dynamic Gaussians stay
    within them, at a cost proportional to the tiles.

    Args:
        tiles: the tiles that dynamic Gaussians reach.
        picture: ``[H, W, 3]`` rendering outside the tiles, at least as far as the loss window reads beyond them. It is
            drawn into in place, so its tiles contain the last rendering.
        static: static Gaussians that reach the tiles; without gradient.
        changed: the tiles whose pixels changed.
        background: ``[3]`` colour behind the scene; None for black.
    """

    tiles: TileSelection
    picture: Tensor
    static: Gaussians
    changed: TileSelection
    background: Tensor | None = None
