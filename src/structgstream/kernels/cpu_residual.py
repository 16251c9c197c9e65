# SPDX-License-Identifier: Apache-2.0
"""A rendering's difference to a picture in this package's C++; the contract is kernels.operations.PictureResidual."""

import ctypes

import torch
from torch import Tensor

from structgstream.errors import OutOfMemoryError
from structgstream.kernels._load import native_library
from structgstream.kernels.prototypes import addresses
from structgstream.kernels.raster_types import TileSelection


class _Residual(ctypes.Structure):
    """``sgs_residual`` of csrc/include/structgstream.h."""

    _fields_ = (
        *((name, ctypes.c_void_p) for name in ("rendering", "gains", "biases", "picture", "tiles", "outside", "mask")),
        *((name, ctypes.c_int) for name in ("height", "width", "reduced_height", "reduced_width")),
    )


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
    """See ``kernels.operations.PictureResidual``; float32.

    Raises:
        OutOfMemoryError: there is no memory for the differences.
    """
    assert (tiles is None) == (outside is None), "tiles need a picture for what is outside of them"
    assert (gains is None) == (biases is None), "gains and biases belong together"
    assert picture.dtype == torch.uint8, picture.dtype
    floats = [None if t is None else t.detach().float().contiguous() for t in (rendering, gains, biases)]
    bytes_ = [None if t is None else t.contiguous() for t in (picture, tiles and tiles.mask, outside, mask)]
    assert outside is None or outside.shape == rendering.shape, (outside.shape, rendering.shape)
    assert mask is None or mask.shape == picture.shape[:2], (mask.shape, picture.shape)
    given = _Residual(*addresses(*floats, *bytes_), *rendering.shape[:2], *picture.shape[:2])
    found = torch.empty(picture.shape[:2])
    if native_library().sgs_picture_residual(ctypes.byref(given), *addresses(found)):
        raise OutOfMemoryError("to compare a rendering with its picture")
    return found
