# SPDX-License-Identifier: Apache-2.0
"""Types that all rasterisers share: selections of tiles, and the result."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

TILE_PIXELS = 16
"""Side of a tile, pixels; parts of a picture are selected by tile."""


def tile_grid(width: int, height: int) -> tuple[int, int]:
    """Number of rows and columns of tiles of a picture; the last ones may be partial."""
    return -(-height // TILE_PIXELS), -(-width // TILE_PIXELS)


@dataclass(frozen=True)
class TileSelection:
    """A selection of a picture's tiles.

    Args:
        mask: ``[rows, columns]`` bool.
        width: of the picture, pixels.
        height: of the picture, pixels.
    """

    mask: Tensor
    width: int
    height: int

    def __post_init__(self) -> None:
        assert self.mask.dtype == torch.bool, self.mask.dtype
        assert self.mask.shape == tile_grid(self.width, self.height), (self.mask.shape, self.width, self.height)

    @classmethod
    def of(cls, pixels: Tensor) -> "TileSelection":
        """The tiles that hold a pixel of the mask ``[H, W]``."""
        height, width = pixels.shape
        rows, columns = tile_grid(width, height)
        padded = pixels.new_zeros(rows * TILE_PIXELS, columns * TILE_PIXELS)
        padded[:height, :width] = pixels
        return cls(padded.reshape(rows, TILE_PIXELS, columns, TILE_PIXELS).any(3).any(1), width, height)

    def pixels(self) -> Tensor:
        """Mask ``[H, W]`` of the pixels in the selected tiles; the same tensor in every call."""
        return self._pixels

    @cached_property
    def _pixels(self) -> Tensor:
        rows = self.mask.repeat_interleave(TILE_PIXELS, 0)
        return rows.repeat_interleave(TILE_PIXELS, 1)[: self.height, : self.width]

    def choose(self, inside: Tensor, outside: Tensor) -> Tensor:
        """A picture ``[H, W, 3]``: ``inside`` in the selected tiles, ``outside`` elsewhere."""
        return torch.where(self._samples, inside, outside)

    @cached_property
    def _samples(self) -> Tensor:
        """Mask ``[H, W, 3]``: a mask that is broadcast over the channels takes two to three times as long."""
        return torch.stack([self._pixels] * 3, dim=-1)

    def count_pixels(self) -> int:
        """Number of pixels in the selected tiles."""
        rows, columns = self.mask.shape
        heights = self.mask.new_full((rows,), TILE_PIXELS, dtype=torch.int64)
        widths = self.mask.new_full((columns,), TILE_PIXELS, dtype=torch.int64)
        heights[-1] -= rows * TILE_PIXELS - self.height
        widths[-1] -= columns * TILE_PIXELS - self.width
        return int(heights @ self.mask.to(torch.int64) @ widths)


@dataclass(frozen=True)
class RasterOutput:
    """One rendering.

    Args:
        image: ``[H, W, 3]``, not clamped; in tiles that were not selected zero, or the pixels of ``onto``.
        alpha: ``[H, W]`` coverage in [0, 1]; zero in tiles that were not selected.
        radii: ``[N]`` float32 pixels, 0 where a Gaussian was not drawn.
    """

    image: Tensor
    alpha: Tensor
    radii: Tensor


Rasterizer = Callable[..., RasterOutput]
"""A function with the arguments of ``reference_raster.rasterize``."""
