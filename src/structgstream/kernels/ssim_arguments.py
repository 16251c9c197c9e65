# SPDX-License-Identifier: Apache-2.0
"""Checks and orders the arguments of the CPU and CUDA loss kernels."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from structgstream.errors import BackendError
from structgstream.kernels.prototypes import addresses
from structgstream.kernels.raster_types import TileSelection


@dataclass(frozen=True)
class Comparison:
    """The arguments of ``kernels.operations.L1SSIM`` other than ``image``: contiguous, gains and biases float32."""

    target: Tensor
    gains: Tensor | None
    biases: Tensor | None
    tiles: TileSelection | None

    @classmethod
    def of(
        cls, image: Tensor, target: Tensor, gains: Tensor | None, biases: Tensor | None, tiles: TileSelection | None
    ) -> "Comparison":
        """The checked arguments.

        Raises:
            BackendError: a precision, layout or size that the kernels do not support.
        """
        if image.dtype != torch.float32 or target.dtype not in (torch.float32, torch.uint8):
            raise BackendError(
                f"The cpu and cuda back-ends compare float32 pictures with float32 or uint8 ones, not {image.dtype} "
                f"with {target.dtype}; convert them or take the reference back-end."
            )
        if image.shape != target.shape or image.ndim != 3 or image.shape[2] != 3 or image.numel() == 0:
            raise BackendError(
                f"Two pictures [H, W, 3] of one size are expected, got {tuple(image.shape)} and {tuple(target.shape)}."
            )
        gains, biases = (None if t is None else t.detach().float().contiguous() for t in (gains, biases))
        assert (gains is None) == (biases is None)
        assert all(t is None or t.shape == (3,) for t in (gains, biases))
        assert tiles is None or (tiles.height, tiles.width) == image.shape[:2], tiles
        if tiles is not None:
            tiles = replace(tiles, mask=tiles.mask.contiguous())
        return cls(target.contiguous(), gains, biases, tiles)

    def arguments(self, image: Tensor) -> list[int | None]:
        """The first arguments of a loss kernel; addresses are valid while ``image`` and this object exist."""
        is_bytes = self.target.dtype == torch.uint8
        targets = (None, self.target) if is_bytes else (self.target, None)
        mask = None if self.tiles is None else self.tiles.mask  # One byte per tile.
        return [*addresses(image, *targets), *image.shape[:2], *addresses(self.gains, self.biases, mask)]
