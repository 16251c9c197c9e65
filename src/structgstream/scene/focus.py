# SPDX-License-Identifier: Apache-2.0
"""Partial rendering: only the tiles that moving Gaussians reach are drawn."""

from dataclasses import dataclass

from torch import Tensor

from structgstream.gaussians import Gaussians
from structgstream.kernels.values import TileSelection


@dataclass(frozen=True)
class Focus:
    """The tiles of one camera's picture that optimisation can change.

    Drawing with a focus gives the pixels of a full rendering in these tiles, as long as the moving Gaussians stay
    within them, at a cost proportional to the tiles.

    Args:
        tiles: those that moving Gaussians reach.
        picture: ``[H, W, 3]`` the full picture outside the tiles, at least as far as the loss window reads beyond them.
            Drawn into in place: its tiles hold the last drawing.
        still: Gaussians that reach the tiles and do not move; without gradient.
        changed: those of the tiles in which something has changed; None if that is not known.
        background: ``[3]`` colour behind the scene; None for black.
    """

    tiles: TileSelection
    picture: Tensor
    still: Gaussians
    changed: TileSelection | None = None
    background: Tensor | None = None
