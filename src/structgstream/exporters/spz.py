# SPDX-License-Identifier: Apache-2.0
"""Niantic's ``.spz``, versions 2 to 4: quantized attributes, stored one after another, compressed.

Note [Versions of SPZ]
~~~~~~~~~~~~~~~~~~~~~~
Version 2 stores three 8-bit components of a quaternion, versions 3 and 4 the smallest three in 10 bits each. Versions 2
and 3 are one gzip stream; version 4 has a plain header and a zstd stream for each attribute. x points right, y up and z
back; a capture has y down and z forward.

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
import zstandard
from torch import Tensor

from structgstream.errors import ConfigError
from structgstream.exporters.baked_gaussians import BakedGaussians
from structgstream.exporters.formats import FrameOptions, SpzVersion

MAGIC = 0x5053474E
HEADER = struct.Struct("<IIIBBBB")  # magic, version, count, degree, fractional bits, flags, reserved or streams
MAX_FRACTIONAL_BITS = 20
COLOR_SCALE = 0.15
LARGEST = 2**23 - 1


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


def spz_bytes(gaussians: BakedGaussians, options: FrameOptions | None = None) -> bytes:
    """A whole ``.spz`` file, in the units of ``gaussians`` (whose axes are OpenCV's) and the axes of the format.

    Raises:
        ConfigError: a position does not fit.
    """
    version: SpzVersion = 2 if options is None else options.spz_version
    bits = fractional_bits(gaussians.means)
    gaussians = gaussians.y_up()
    quats = torch.nn.functional.normalize(gaussians.quats, dim=1)
    # Readers convert opacities to logits, which are not finite for 0 and 255.
    opacities = _bytes(255.0 * gaussians.opacities).clip(1, 254)
    parts = [
        _fixed_point(gaussians.means, bits),
        opacities.tobytes(),
        _bytes((gaussians.sh[:, 0] * COLOR_SCALE + 0.5) * 255.0).tobytes(),
        _bytes((gaussians.scales.log() + 10.0) * 16.0).tobytes(),
        _first_three(quats) if version == 2 else _smallest_three(quats),
        _bytes(gaussians.sh[:, 1:] * 128.0 + 128.0).tobytes(),
    ]
    if version < 4:
        header = HEADER.pack(MAGIC, version, len(gaussians), gaussians.degree, bits, 0, 0)
        return gzip.compress(header + b"".join(parts), mtime=0)
    parts = [part for part in parts if part]  # as the reference implementation: no stream of degree 0
    header = HEADER.pack(MAGIC, version, len(gaussians), gaussians.degree, bits, 0, len(parts))
    coded = [zstandard.ZstdCompressor(level=12).compress(part) for part in parts]
    contents = b"".join(struct.pack("<QQ", len(c), len(part)) for c, part in zip(coded, parts, strict=True))
    return header + struct.pack("<I12x", HEADER.size + 16) + contents + b"".join(coded)


def _fixed_point(values: Tensor, bits: int) -> bytes:
    """24-bit little endian two's complement."""
    fixed = (values.cpu().double() * 2.0**bits).round().to(torch.int32).numpy().astype(np.dtype("<i4"))
    return fixed.view(np.uint8).reshape(-1, 4)[:, :3].tobytes()


def _first_three(quats: Tensor) -> bytes:
    """x, y and z with a positive w."""
    return _bytes(torch.where(quats[:, :1] < 0.0, -quats, quats)[:, 1:] * 127.5 + 127.5).tobytes()


def _smallest_three(quats: Tensor) -> bytes:
    """32 bits: the place of the largest of x, y, z, w, and sign and 9-bit magnitude of the others in this order."""
    xyzw = quats[:, [1, 2, 3, 0]].cpu().double().numpy()
    rows = np.arange(len(xyzw))
    largest = np.abs(xyzw).argmax(1)
    xyzw = np.where(xyzw[rows, largest] < 0.0, -1.0, 1.0)[:, None] * xyzw
    others = xyzw[np.arange(4) != largest[:, None]].reshape(-1, 3)
    magnitudes = np.minimum(np.floor(np.abs(others) * math.sqrt(2.0) * 511.0 + 0.5), 511).astype(np.uint32)
    packed = largest.astype(np.uint32)
    for column in range(3):
        packed = packed << 10 | (others[:, column] < 0.0).astype(np.uint32) << 9 | magnitudes[:, column]
    return packed.astype("<u4").tobytes()


def _bytes(values: Tensor) -> np.ndarray:
    return values.round().clamp(0, 255).to(torch.uint8).cpu().numpy()
