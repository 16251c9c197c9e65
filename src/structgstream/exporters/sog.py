# SPDX-License-Identifier: Apache-2.0
"""PlayCanvas' ``.sog``, version 2: a zip of lossless WebP pictures and ``meta.json``, a pixel per Gaussian.

Positions have 16 bits of ``sign(x) log(1 + |x|)`` in two pictures, quaternions the smallest three components in 8 bits
each, scales and constant colours an index into a codebook of 256 values. The other coefficients of a Gaussian are an
entry of a palette, whose values are indices into another codebook.
"""

import io
import json
import math
import zipfile

import numpy as np
from numpy.typing import NDArray

from structgstream.errors import MissingExtraError
from structgstream.exporters.baked_gaussians import BakedGaussians
from structgstream.exporters.formats import FrameOptions
from structgstream.scene.order import morton_order

_MAX_PALETTE_BITS = 16
_PALETTE_COLUMNS = 64
_LLOYD_ITERATIONS = 12

Floats = NDArray[np.float32]
Bytes = NDArray[np.uint8]


def sog_bytes(gaussians: BakedGaussians, options: FrameOptions | None = None) -> bytes:
    """A whole ``.sog`` file, in the units and axes of ``gaussians``.

    Raises:
        MissingExtraError: Pillow is not installed.
    """
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
        "quats": _smallest_three(gaussians.quats.cpu().numpy()),
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
    """At most 2^16 means of similar rows, and the mean of each row.

    Rows are halved at the median of the component that varies most within a group until there are enough groups.

    Args:
        rows: ``[N, C]``.

    Returns:
        the means ``[P, C]``, and the index of its mean for each row ``[N]``.
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


def _smallest_three(quats: Floats) -> Bytes:
    """The three smaller components of wxyz, and 252 plus the index of the largest."""
    largest = np.abs(quats).argmax(1)
    signed = quats * np.where(np.take_along_axis(quats, largest[:, None], 1) < 0, -1.0, 1.0)
    others = signed[np.arange(4) != largest[:, None]].reshape(-1, 3)
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
    try:
        from PIL import Image
    except ImportError:
        raise MissingExtraError("PIL", "export") from None
    data = io.BytesIO()
    # exact: the colour of transparent pixels matters.
    Image.fromarray(picture).save(data, "WEBP", lossless=True, exact=True)
    return data.getvalue()
