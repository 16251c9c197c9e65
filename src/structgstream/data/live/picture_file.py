# SPDX-License-Identifier: Apache-2.0
"""A frame's pictures in a file: for the queue of ``every``, and for what a resumed run needs.

A line of JSON, then the pictures and masks one after the other, compressed without loss, with a checksum.

Note [Residuals]
~~~~~~~~~~~~~~~~
Of a picture is stored, modulo 256, by how much each value differs from what the values to its left and above it let one
expect if the picture were a plane there (left + above - above left), with red and blue as differences from green. That
takes two subtractions of whole arrays, is undone by two running sums, and leaves zstd half as much to store.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import zstandard
from numpy.typing import NDArray

from structgstream.atomic_files import atomic_write
from structgstream.errors import CaptureError
from structgstream.frames import MultiViewFrame

FORMAT = "structgstream-pictures-2"
WITHOUT_RESIDUALS = "structgstream-pictures-1"  # which a run of an earlier version may have left
LEVEL = 1  # 300 MB/s and more, at about the sizes of higher levels: noise does not compress
MAX_HEADER = 1 << 20


def write_pictures(path: Path, frame: MultiViewFrame, *, sync: bool, **facts: Any) -> int:
    """Writes a frame's pictures, whole or not at all; the size of the file in bytes.

    Args:
        path: the file.
        frame: its pictures ``[H, W, 3]`` and masks ``[H, W]``.
        sync: whether it is on the disk on return, so that it outlives a power failure.
        facts: plain JSON values to be read again.

    Raises:
        StorageError: the file cannot be written.
    """
    arrays: dict[str, Mapping[str, NDArray[Any]]] = {"images": frame.images, "masks": frame.masks}
    compressor = zstandard.ZstdCompressor(level=LEVEL, write_checksum=True)
    packed = {
        "images": {name: compressor.compress(residuals(image).tobytes()) for name, image in frame.images.items()},
        "masks": {name: compressor.compress(mask.tobytes()) for name, mask in frame.masks.items()},
    }
    entries = {
        kind: {name: [list(array.shape), len(packed[kind][name])] for name, array in own.items()}
        for kind, own in arrays.items()
    }
    header = {"format": FORMAT, "index": frame.index, "pts_seconds": frame.pts_seconds,
              "captured_unix_seconds": frame.captured_unix_seconds, **facts, **entries}  # fmt: skip
    content = [json.dumps(header).encode() + b"\n", *(data for own in packed.values() for data in own.values())]
    atomic_write(path, content, called="The pictures", sync=sync)
    return sum(map(len, content))


def read_pictures(path: Path) -> tuple[MultiViewFrame, dict[str, Any]]:
    """The frame of a file, and the facts beside it.

    Raises:
        CaptureError: the file is missing or damaged.
    """
    try:
        with path.open("rb") as file:
            header: dict[str, Any] = json.loads(file.readline(MAX_HEADER))
            written = header.pop("format")
            if written not in (FORMAT, WITHOUT_RESIDUALS):
                raise ValueError("another format")
            images = {name: _read(file, entry, np.uint8, (3,)) for name, entry in header.pop("images").items()}
            masks = {name: _read(file, entry, np.bool_, ()) for name, entry in header.pop("masks").items()}
        if written == FORMAT:
            images = {name: restored(image) for name, image in images.items()}
        times = float(header.pop("pts_seconds")), header.pop("captured_unix_seconds")
        return MultiViewFrame(int(header.pop("index")), times[0], images, masks, times[1]), header
    except FileNotFoundError:
        raise CaptureError(f"The pictures {path} are missing.") from None
    except (OSError, ValueError, KeyError, TypeError, zstandard.ZstdError) as error:
        raise CaptureError(f"The pictures {path} are damaged ({error}).") from None


def residuals(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """A picture ``[H, W, 3]`` as residuals ``[3, H, W]`` (Note [Residuals])."""
    planes = image.transpose(2, 0, 1).copy()
    planes[0] -= planes[1]
    planes[2] -= planes[1]
    planes[:, :, 1:] = planes[:, :, 1:] - planes[:, :, :-1]
    planes[:, 1:] = planes[:, 1:] - planes[:, :-1]
    return planes


def restored(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The picture ``[H, W, 3]`` of residuals that were stored in an array of its shape."""
    height, width, _ = image.shape
    planes = image.reshape(3, height, width)
    np.add.accumulate(planes, axis=1, out=planes)
    np.add.accumulate(planes, axis=2, out=planes)
    planes[0] += planes[1]
    planes[2] += planes[1]
    return np.ascontiguousarray(planes.transpose(1, 2, 0))


def _read(file: Any, entry: Any, kind: type[Any], last: tuple[int, ...]) -> NDArray[Any]:
    shape, size = tuple(int(side) for side in entry[0]), int(entry[1])
    if len(shape) != 2 + len(last) or shape[2:] != last or not all(0 < side <= 1 << 16 for side in shape[:2]):
        raise ValueError(f"shape {shape}")
    count = int(np.prod(shape))
    data = zstandard.ZstdDecompressor().decompress(file.read(min(size, 2 * count + 1024)), max_output_size=count)
    return np.frombuffer(bytearray(data), kind).reshape(shape)  # a copy that may be written to
