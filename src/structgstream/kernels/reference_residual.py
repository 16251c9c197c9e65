# SPDX-License-Identifier: Apache-2.0
"""How a rendering differs from a picture, in pure torch: the oracle."""

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate

from structgstream.kernels.raster_types import TileSelection


def picture_residual(
    rendering: Tensor,
    picture: Tensor,
    *,
    gains: Tensor | None = None,
    biases: Tensor | None = None,
    tiles: TileSelection | None = None,
    outside: Tensor | None = None,
    mask: Tensor | None = None,
) -> Tensor:
    """See ``kernels.operations.PictureResidual``, in the precision of ``rendering``."""
    recorded = rendering if gains is None or biases is None else rendering * gains + biases
    recorded = recorded.clamp(0.0, 1.0)
    if tiles is not None and outside is not None:
        recorded = tiles.choose(recorded, outside.to(recorded) / 255.0)
    reduced = interpolate(recorded.permute(2, 0, 1)[None], size=picture.shape[:2], mode="area")[0].permute(1, 2, 0)
    off = (reduced - picture.to(reduced) / 255.0).abs().mean(-1)
    off = off if mask is None else torch.where(mask, off, 0.0)
    found = avg_pool2d(off[None, None], 3, stride=1, padding=1, count_include_pad=False)[0, 0]
    return found if mask is None else torch.where(mask, found, 0.0)
