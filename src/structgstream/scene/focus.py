# SPDX-License-Identifier: Apache-2.0
"""A part of a picture: what moves there is drawn anew, the rest is there already."""

from dataclasses import dataclass

from torch import Tensor

from structgstream.gaussians import Gaussians
from structgstream.kernels.raster_types import TileSelection


@dataclass(frozen=True)
class Focus:
    """Where a camera's picture can differ from the one before.

    Drawing with a focus gives in its tiles what drawing everything would give, as long as what moves stays within
    them, at the cost of the tiles.

    Args:
        tiles: those that moving Gaussians reach.
        picture: ``[H, W, 3]`` the rest of the picture, as far as a loss looks beyond the tiles; drawn onto in place.
            In the tiles it shows what was drawn there last.
        still: Gaussians that reach the tiles and do not move; without gradient.
    """

    tiles: TileSelection
    picture: Tensor
    still: Gaussians
