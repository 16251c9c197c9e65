# SPDX-License-Identifier: Apache-2.0
"""Formats of web viewers: ``.splat``, ``.spz``, ``.sog``, and glTF's ``.glb`` with ``KHR_gaussian_splatting``.

``.splat`` has 32 bytes per Gaussian without a header, the most important ones first: float32 position and scales (not
logarithms), 8-bit red, green, blue and opacity, and an 8-bit quaternion wxyz with the components ``(byte - 128) /
128``. Its colour does not depend on the direction.

Note [Versions of SPZ]
~~~~~~~~~~~~~~~~~~~~~~
Niantic's ``.spz`` has quantized attributes, one after another, compressed. Version 2 stores three 8-bit components of a
quaternion, versions 3 and 4 the smallest three in 10 bits each. Versions 2 and 3 are one gzip stream; version 4 has a
plain header and a zstd stream for each attribute. x points right, y up and z back; a capture has y down and z forward.

Note [Precision of SPZ]
~~~~~~~~~~~~~~~~~~~~~~~
Positions are 24-bit fixed-point numbers. The writer chooses the number of fractional bits: here the largest with which
the farthest Gaussian fits. Scales are clamped to ``e^-10`` ... ``e^5.9`` units, in steps of 6 %. All coefficients
except the constant one are clamped to -1 ... 1, and use all of their 8 bits.

Note [SOG]
~~~~~~~~~~
PlayCanvas' ``.sog``, version 2, is a zip of lossless WebP pictures and ``meta.json``, a pixel per Gaussian. Positions
have 16 bits of ``sign(x) log(1 + |x|)`` in two pictures, quaternions the smallest three components in 8 bits each,
scales and constant colours an index into a codebook of 256 values. The other coefficients of a Gaussian are an entry of
a palette, whose values are indices into another codebook.
"""

import gzip
import io
import json
import math
import struct
import zipfile

import numpy as np
import torch
import zstandard
from numpy.typing import NDArray
from torch import Tensor

from structgstream.errors import ConfigError, import_extra
from structgstream.exporters.bake import BakedGaussians
from structgstream.exporters.formats import FrameOptions
from structgstream.harmonics import Y0
from structgstream.scene.order import morton_order

ROW = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("quat", "u1", 4)])


def splat_bytes(gaussians: BakedGaussians, options: FrameOptions) -> bytes:
    """A whole ``.splat`` file, in the units and axes of ``gaussians``.

    Raises:
        ConfigError: colours depend on direction. Their constant coefficient alone is not the mean over the cameras.
    """
    if gaussians.degree:
        raise ConfigError(
            f"A .splat file has one colour per Gaussian, got spherical harmonics of degree {gaussians.degree}; "
            "bake with degree 0."
        )
    gaussians = gaussians.select(gaussians.by_importance())  # a partly loaded file shows the largest ones
    rows = np.empty(len(gaussians), ROW)
    rows["mean"] = gaussians.means.cpu().numpy()
    rows["scale"] = gaussians.scales.cpu().numpy()
    rows["rgba"] = _bytes(255.0 * torch.cat([0.5 + Y0 * gaussians.sh[:, 0], gaussians.opacities[:, None]], dim=1))
    rows["quat"] = _bytes(128.0 * torch.nn.functional.normalize(gaussians.quats, dim=1) + 128.0)
    return rows.tobytes()


MAGIC = 0x5053474E
HEADER = struct.Struct("<IIIBBBB")  # magic, version, count, degree, fractional bits, flags, reserved or streams
MAX_FRACTIONAL_BITS = 20
COLOR_SCALE = 0.15
LARGEST = 2**23 - 1


def fractional_bits(means: Tensor) -> int:
    """Bits after the binary point with which all of ``means`` fit into 24 bits. Raises ConfigError if they do not fit
    with none."""
    farthest = float(means.abs().max()) if means.numel() else 0.0
    if not farthest <= LARGEST:
        raise ConfigError(
            f"A Gaussian is {farthest:g} units from the origin, and an .spz file reaches {LARGEST}; export a .ply."
        )
    return min(MAX_FRACTIONAL_BITS, int(math.log2(LARGEST / max(farthest, 1.0))))


def spz_bytes(gaussians: BakedGaussians, options: FrameOptions) -> bytes:
    """A whole ``.spz`` file, in the units of ``gaussians`` (whose axes are OpenCV's) and the axes of the format. Raises
    ConfigError if a position does not fit."""
    version = options.spz_version
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
        _first_three(quats) if version == 2 else _smallest_three_bits(quats),
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


def _smallest_three(quats: NDArray[np.floating]) -> tuple[NDArray[np.intp], NDArray[np.floating]]:
    """The place ``[N]`` of the largest component of each of ``[N, 4]``, and the others ``[N, 3]`` if it is positive."""
    largest = np.abs(quats).argmax(1)
    signed = quats * np.where(np.take_along_axis(quats, largest[:, None], 1) < 0, -1.0, 1.0)
    return largest, signed[np.arange(4) != largest[:, None]].reshape(-1, 3)


def _smallest_three_bits(quats: Tensor) -> bytes:
    """32 bits: the place of the largest of x, y, z, w, and sign and 9-bit magnitude of the others in this order."""
    largest, others = _smallest_three(quats[:, [1, 2, 3, 0]].cpu().double().numpy())
    magnitudes = np.minimum(np.floor(np.abs(others) * math.sqrt(2.0) * 511.0 + 0.5), 511).astype(np.uint32)
    packed = largest.astype(np.uint32)
    for column in range(3):
        packed = packed << 10 | (others[:, column] < 0.0).astype(np.uint32) << 9 | magnitudes[:, column]
    return packed.astype("<u4").tobytes()


def _bytes(values: Tensor) -> np.ndarray:
    return values.round().clamp(0, 255).to(torch.uint8).cpu().numpy()


_MAX_PALETTE_BITS = 16
_PALETTE_COLUMNS = 64
_LLOYD_ITERATIONS = 12

Floats = NDArray[np.float32]
Bytes = NDArray[np.uint8]


def sog_bytes(gaussians: BakedGaussians, options: FrameOptions) -> bytes:
    """A whole ``.sog`` file, in the units and axes of ``gaussians``. Raises MissingExtraError if Pillow is not
    installed."""
    gaussians = gaussians.select(morton_order(gaussians.means))
    count = len(gaussians)
    width = math.ceil(math.sqrt(count) / 4) * 4
    height = math.ceil(count / width / 4) * 4
    means = gaussians.means.cpu().double().numpy()
    logs = np.sign(means) * np.log1p(np.abs(means))
    low, high = logs.min(0), logs.max(0)
    fixed = np.rint((logs - low) / np.maximum(high - low, 1e-30) * 65535).astype(np.uint16)
    scale_book, scales = codebook(gaussians.scales.log().cpu().numpy())
    sh = gaussians.sh.cpu().numpy()
    color_book, colors = codebook(sh[:, 0])
    opacities = np.rint(gaussians.opacities.cpu().numpy() * 255).astype(np.uint8)
    pictures = {
        "means_l": _opaque(fixed & 255),
        "means_u": _opaque(fixed >> 8),
        "quats": _smallest_three_bytes(gaussians.quats.cpu().numpy()),
        "scales": _opaque(scales),
        "sh0": np.concatenate([colors, opacities[:, None]], axis=1),
    }
    meta: dict[str, object] = {
        "version": 2,
        "asset": {"generator": "structgstream"},
        "count": count,
        "means": {"mins": low.tolist(), "maxs": high.tolist(), "files": ["means_l.webp", "means_u.webp"]},
        "scales": {"codebook": scale_book.tolist(), "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": color_book.tolist(), "files": ["sh0.webp"]},
    }
    files = {name: _webp(_picture(rows, width, height)) for name, rows in pictures.items()}
    if gaussians.degree:
        palette, labels = vector_palette(sh[:, 1:].reshape(count, -1))
        book, entries = codebook(palette)
        rows = math.ceil(len(palette) / _PALETTE_COLUMNS)
        coefficients = sh.shape[1] - 1
        # A row of the picture has 64 entries, an entry a pixel of red, green and blue for each coefficient.
        centroids = _picture(_opaque(entries.reshape(-1, 3)), _PALETTE_COLUMNS * coefficients, rows)
        split = np.stack([labels & 255, labels >> 8, np.zeros_like(labels)], axis=1)
        files["shN_centroids"], files["shN_labels"] = _webp(centroids), _webp(_picture(_opaque(split), width, height))
        meta["shN"] = {
            "count": len(palette),
            "bands": gaussians.degree,
            "codebook": book.tolist(),
            "files": ["shN_centroids.webp", "shN_labels.webp"],
        }
    contents = {"meta.json": json.dumps(meta).encode(), **{f"{name}.webp": data for name, data in files.items()}}
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w") as file:
        for name, data in contents.items():
            file.writestr(zipfile.ZipInfo(name), data)  # with a fixed date
    return archive.getvalue()


def codebook(values: Floats) -> tuple[Floats, Bytes]:
    """256 ascending values, and the index of the nearest for each of ``values``: k-means in one dimension.

    Returns:
        the values ``[256]``, and indices of the shape of ``values``.
    """
    ordered = np.sort(values, axis=None).astype(np.float64)
    # Half of the start is spread over the values, half over the range: rare large values matter, too.
    ends = np.linspace(ordered[0], ordered[-1], 128), ordered[np.linspace(0, len(ordered) - 1, 128).astype(int)]
    book = np.sort(np.concatenate(ends))
    sums = np.concatenate([[0.0], np.cumsum(ordered)])
    for _ in range(_LLOYD_ITERATIONS):
        borders = np.searchsorted(ordered, (book[1:] + book[:-1]) / 2)
        edges = np.concatenate([[0], borders, [len(ordered)]])
        counts = np.diff(edges)
        book = np.sort(np.where(counts > 0, np.diff(sums[edges]) / np.maximum(counts, 1), book))
    return book.astype(np.float32), np.searchsorted((book[1:] + book[:-1]) / 2, values).astype(np.uint8)


def vector_palette(rows: Floats) -> tuple[Floats, NDArray[np.int64]]:
    """At most 2^16 means ``[P, C]`` of similar rows ``[N, C]``, and the index of the mean of each row ``[N]``.

    Rows are halved at the median of the component that varies most within a group until there are enough groups.
    """
    group = np.zeros(len(rows), np.int64)
    if len(rows) <= 1 << _MAX_PALETTE_BITS:
        return rows, np.arange(len(rows))
    for level in range(_MAX_PALETTE_BITS):
        counts = np.bincount(group, minlength=1 << level)[:, None]
        means = _sums(group, rows, 1 << level) / counts
        spread = _sums(group, rows**2, 1 << level) / counts - means**2
        order = np.lexsort((rows[np.arange(len(rows)), spread.argmax(1)[group]], group))
        place = np.arange(len(rows)) - (np.cumsum(counts) - counts[:, 0])[group[order]]
        group[order] = 2 * group[order] + (place >= (counts[:, 0] // 2)[group[order]])
    return (_sums(group, rows, 1 << _MAX_PALETTE_BITS) / np.bincount(group)[:, None]).astype(np.float32), group


def _sums(group: NDArray[np.int64], rows: Floats, count: int) -> NDArray[np.float64]:
    return np.stack([np.bincount(group, column, count) for column in rows.T], axis=1).astype(np.float64)


def _smallest_three_bytes(quats: Floats) -> Bytes:
    """The three smaller components of wxyz, and 252 plus the index of the largest."""
    largest, others = _smallest_three(quats)
    packed = np.rint((others * math.sqrt(0.5) + 0.5) * 255).clip(0, 255)
    return np.concatenate([packed, 252 + largest[:, None]], axis=1).astype(np.uint8)


def _opaque(rgb: NDArray[np.integer]) -> Bytes:
    return np.concatenate([rgb, np.full((len(rgb), 1), 255)], axis=1).astype(np.uint8)


def _picture(rows: Bytes, width: int, height: int) -> Bytes:
    """RGBA rows in reading order, the rest black."""
    found = np.zeros((height * width, 4), np.uint8)
    found[: len(rows)] = rows
    return found.reshape(height, width, 4)


def _webp(picture: Bytes) -> bytes:
    data = io.BytesIO()
    # exact: the colour of transparent pixels matters.
    import_extra("PIL.Image", "export").fromarray(picture).save(data, "WEBP", lossless=True, exact=True)
    return data.getvalue()


EXTENSION = "KHR_gaussian_splatting"
_FLOAT, _UNSIGNED_BYTE, _ARRAY_BUFFER, _POINTS = 5126, 5121, 34962, 0
_TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}


def glb_bytes(gaussians: BakedGaussians, options: FrameOptions) -> bytes:
    """A whole ``.glb`` file, in the units of ``gaussians`` and the axes of glTF."""
    gaussians = gaussians.y_up()
    constant = (0.5 + Y0 * gaussians.sh[:, 0]).clamp(0.0, 1.0)
    linear = torch.where(constant <= 0.04045, constant / 12.92, ((constant + 0.055) / 1.055) ** 2.4)
    color = torch.cat([linear, gaussians.opacities[:, None]], dim=1)
    columns = {
        "POSITION": gaussians.means,
        "COLOR_0": (color * 255.0).round().clamp(0, 255).to(torch.uint8),
        f"{EXTENSION}:ROTATION": torch.nn.functional.normalize(gaussians.quats, dim=1)[:, [1, 2, 3, 0]],
        f"{EXTENSION}:SCALE": gaussians.scales,
        f"{EXTENSION}:OPACITY": gaussians.opacities.clamp(0.0, 1.0)[:, None],
        **{
            f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{order}": gaussians.sh[:, degree * degree + order]
            for degree in range(gaussians.degree + 1)
            for order in range(2 * degree + 1)
        },
    }
    accessors, views, binary = [], [], bytearray()
    for name, column in columns.items():
        values: NDArray[np.generic] = np.ascontiguousarray(column.cpu().numpy())
        accessor = {
            "bufferView": len(views),
            "componentType": _UNSIGNED_BYTE if values.dtype == np.uint8 else _FLOAT,
            "count": len(values),
            "type": _TYPES[values.shape[1]],
        }
        if name == "POSITION":
            accessor |= {"min": values.min(0).tolist(), "max": values.max(0).tolist()}
        if values.dtype == np.uint8:
            accessor["normalized"] = True
        accessors.append(accessor)
        data = values.tobytes()  # every column has a multiple of four bytes
        views.append({"buffer": 0, "byteOffset": len(binary), "byteLength": len(data), "target": _ARRAY_BUFFER})
        binary += data
    primitive = {
        "attributes": {name: place for place, name in enumerate(columns)},
        "mode": _POINTS,
        "extensions": {
            EXTENSION: {
                "kernel": "ellipse",
                "colorSpace": "srgb_rec709_display",
                "sortingMethod": "cameraDistance",
                "projection": "perspective",
            }
        },
    }
    document = {
        "asset": {"version": "2.0", "generator": "structgstream"},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(binary)}],
    }
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(text) + 8 + len(binary))
    return head + struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary
