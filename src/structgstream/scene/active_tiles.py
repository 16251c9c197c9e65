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
        tiles: those that dynamic Gaussians reach.
        picture: ``[H, W, 3]`` the full picture outside the tiles, at least as far as the loss window reads beyond them.
            Drawn into in place: its tiles hold the last drawing.
        static: Gaussians that reach the tiles and do not move; without gradient.
        changed: those of the tiles in which something has changed; None if that is not known.
        background: ``[3]`` colour behind the scene; None for black.
    """

    tiles: TileSelection
    picture: Tensor
    static: Gaussians
    changed: TileSelection | None = None
    background: Tensor | None = None
