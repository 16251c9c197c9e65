# SPDX-License-Identifier: Apache-2.0
"""Niantic's ``.spz``, version 2: quantised attributes, stored one after another, compressed with gzip.

Note [Axes of SPZ]
~~~~~~~~~~~~~~~~~~
SPZ has x right, y up, z back; a capture has x right, y down, z forward. The conversion is half a turn around x: ``y``
and ``z`` of positions and quaternions change sign, and so does each spherical harmonic of odd degree in ``y`` and ``z``
together. Readers convert to the axes of their application.

Note [Precision of SPZ]
~~~~~~~~~~~~~~~~~~~~~~~
Positions are 24-bit fixed-point numbers. The writer chooses the number of fractional bits: here the largest with which
the farthest Gaussian fits. Scales are clamped to ``e^-10`` ... ``e^5.9`` units, in steps of 6 %. All coefficients
except the constant one are clamped to -1 ... 1, and use all of their 8 bits.
"""

import gzip
import math
import struct

import numpy as np
import torch
from torch import Tensor

from structgstream.errors import ConfigError
from structgstream.exporters.baked_gaussians import BakedGaussians

MAGIC, VERSION = 0x5053474E, 2
HEADER = struct.Struct("<IIIBBBB")  # magic, version, count, degree, fractional bits, flags, reserved
MAX_FRACTIONAL_BITS = 20
COLOR_SCALE = 0.15
LARGEST = 2**23 - 1
SIGNS = (1, -1, -1, 1, -1, 1, 1, -1, 1)
"""Sign changes of the spherical harmonics up to degree 2 under half a turn around x."""


def fractional_bits(means: Tensor) -> int:
    """Bits after the binary point with which all of ``means`` fit into 24 bits.

    Raises:
        ConfigError: they do not fit with none.
    """
    farthest = float(means.abs().max()) if means.numel() else 0.0
    if not farthest <= LARGEST:
        raise ConfigError(
            f"A Gaussian is {farthest:g} units from the origin, and an .spz file reaches {LARGEST}; export a .ply."
        )
    return min(MAX_FRACTIONAL_BITS, int(math.log2(LARGEST / max(farthest, 1.0))))


def spz_bytes(gaussians: BakedGaussians) -> bytes:
    """A whole ``.spz`` file, in the units of ``gaussians`` (whose axes are OpenCV's) and the axes of the format.

    Raises:
        ConfigError: a position does not fit.
    """
    bits = fractional_bits(gaussians.means)
    turned = gaussians.means.new_tensor((1.0, -1.0, -1.0))
    quats = torch.nn.functional.normalize(gaussians.quats, dim=1)
    quats = torch.where(quats[:, :1] < 0.0, -quats, quats)
    signs = gaussians.sh.new_tensor(SIGNS[1 : gaussians.sh.shape[1]])
    # Readers convert opacities to logits, which are not finite for 0 and 255.
    opacities = _bytes(255.0 * gaussians.opacities).clip(1, 254)
    parts = [
        _fixed_point(gaussians.means * turned, bits),
        opacities.tobytes(),
        _bytes((gaussians.sh[:, 0] * COLOR_SCALE + 0.5) * 255.0).tobytes(),
        _bytes((gaussians.scales.log() + 10.0) * 16.0).tobytes(),
        _bytes(quats[:, 1:] * turned * 127.5 + 127.5).tobytes(),
        _bytes(gaussians.sh[:, 1:] * signs[:, None] * 128.0 + 128.0).tobytes(),
    ]
    header = HEADER.pack(MAGIC, VERSION, len(gaussians), gaussians.degree, bits, 0, 0)
    return gzip.compress(header + b"".join(parts), mtime=0)


def _fixed_point(values: Tensor, bits: int) -> bytes:
    """24-bit little endian two's complement."""
    fixed = (values.cpu().double() * 2.0**bits).round().to(torch.int32).numpy().astype(np.dtype("<i4"))
    return fixed.view(np.uint8).reshape(-1, 4)[:, :3].tobytes()


def _bytes(values: Tensor) -> np.ndarray:
    return values.round().clamp(0, 255).to(torch.uint8).cpu().numpy()
