# SPDX-License-Identifier: Apache-2.0
"""Resume cache of a live run: the pictures that a resumed run needs, since no camera sends them twice.

They are those of a period's first frame and of the last frames, in ``OUT.sgs.live`` next to ``OUT.sgs``, or
``OUT.live`` next to the folder ``OUT``. A frame's file is complete before the frame is delivered, so at any
interruption the frame before the first missing one is there. Older frames are removed, so the folder does not grow
(:meth:`ResumeCache.retain`); while no camera shows anything, the last two frames that did are retained, and those after
them are stored as black.

A file is a line of JSON, then the pictures and masks, compressed without loss, with a checksum.

Note [Residuals]
~~~~~~~~~~~~~~~~
Stored are prediction errors, modulo 256: the predictor is the plane through the values to the left and above (left +
above - above left), and red and blue are differences from green. That takes two subtractions of whole arrays, is undone
by two running sums, and halves the compressed size.
"""

import json
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import zstandard
from numpy.typing import NDArray

from structgstream.atomic_files import atomic_write
from structgstream.errors import CaptureError, StorageError
from structgstream.frames import MIN_CAMERAS, MultiViewFrame
from structgstream.owned_folders import check_owned, own_folder

LAST = 3
"""Frames besides the period's first: the one being fitted, the one before it, and one that may have been prefetched."""
FOLDER_PURPOSE = "pictures that a live stream needs to be resumed"
FILE_NAME = re.compile(r"frame-(\d{8,})\.pictures")
FORMAT = "structgstream-pictures-2"
LEVEL = 1  # 300 MB/s and more, at about the sizes of higher levels: noise does not compress
MAX_HEADER = 1 << 20


def resume_folder(stream: Path) -> Path:
    """The folder next to a stream."""
    return stream.with_name(f"{stream.name}.live")


class ResumeCache:
    """The last frames of a live run in a folder, which is made with the first frame.

    What cannot be written, and a folder that holds files of others, is a ``StorageError``; a damaged file is a
    ``CaptureError``.

    Args:
        cameras: names of the cameras whose pictures are stored: held-out ones are not needed.
        resume: whether existing files are of this stream; else they are removed with the first frame.
    """

    def __init__(self, folder: Path, *, cameras: tuple[str, ...], resume: bool) -> None:
        self._folder, self._cameras = folder, cameras
        self._first, self._last = frozenset({0}), LAST
        self._resume = resume
        check_owned(folder, FOLDER_PURPOSE)

    def retain(self, *first: int, last: int) -> None:
        """From now on the frames ``first`` are retained, and the ``last`` frames before the one being fitted."""
        self._first, self._last = frozenset(first), max(last + LAST - 1, LAST)

    def store(self, frame: MultiViewFrame, *, origin_seconds: float) -> None:
        """Stores a frame's pictures, and removes those that are no longer needed; ``origin_seconds`` is the common
        clock at presentation time 0."""
        images = {name: image for name, image in frame.images.items() if name in self._cameras}
        if len(frame.showing(self._cameras)) < MIN_CAMERAS:  # nothing is visible
            images = {name: np.zeros_like(image) for name, image in images.items()}
        masks = {name: mask for name, mask in frame.masks.items() if name in self._cameras}
        own_folder(self._folder, FOLDER_PURPOSE)
        if not self._resume:
            self._remove(self._files())
            self._resume = True
        stored = replace(frame, images=images, masks=masks)
        write_pictures(self._path(frame.index), stored, origin_seconds=origin_seconds)
        oldest = frame.index - self._last + 1
        files = self._files().items()
        self._remove({n: file for n, file in files if n > frame.index or (n < oldest and n not in self._first)})

    def frames(self, start: int) -> Iterator[MultiViewFrame]:
        """The stored frames from index ``start`` on, without a gap; none if ``start`` is the next live frame."""
        index = start
        while self._path(index).is_file():
            yield read_pictures(self._path(index))[0]
            index += 1
        if index == start and start > 0 and not self._path(start - 1).is_file():
            raise CaptureError(
                f"The pictures of frame {start} are not in {self._folder}, and no camera sends them again, so the "
                "stream cannot be resumed; restore the folder, or begin another stream."
            )

    def last(self) -> tuple[float, float] | None:
        """Presentation time of the last stored frame, and the common clock at presentation time 0; None if empty."""
        files = self._files()
        if not files:
            return None
        frame, origin = read_pictures(files[max(files)])
        return frame.pts_seconds, origin

    def _path(self, index: int) -> Path:
        return self._folder / f"frame-{index:08d}.pictures"

    def _files(self) -> dict[int, Path]:
        found = self._folder.iterdir() if self._folder.is_dir() else ()
        return {int(match[1]): file for file in found if (match := FILE_NAME.fullmatch(file.name))}

    def _remove(self, files: dict[int, Path]) -> None:
        try:
            for file in files.values():
                file.unlink(missing_ok=True)
        except OSError as error:
            raise StorageError(f"{error.filename} cannot be removed ({error.strerror}).") from None


def write_pictures(path: Path, frame: MultiViewFrame, *, origin_seconds: float) -> None:
    """Writes a frame's pictures ``[H, W, 3]`` and masks ``[H, W]`` atomically and durably."""
    compressor = zstandard.ZstdCompressor(level=LEVEL, write_checksum=True)
    packed = []

    def pack(array: NDArray[Any]) -> list[Any]:
        packed.append(compressor.compress(array.tobytes()))
        return [list(array.shape), len(packed[-1])]

    header = {
        "format": FORMAT,
        "index": frame.index,
        "pts_seconds": frame.pts_seconds,
        "captured_unix_seconds": frame.captured_unix_seconds,
        "origin_seconds": origin_seconds,
        "images": {name: pack(residuals(image).reshape(image.shape)) for name, image in frame.images.items()},
        "masks": {name: pack(mask) for name, mask in frame.masks.items()},
    }
    atomic_write(path, [json.dumps(header).encode() + b"\n", *packed], called="The pictures")


def read_pictures(path: Path) -> tuple[MultiViewFrame, float]:
    """The frame of a file, and the common clock at presentation time 0."""
    try:
        with path.open("rb") as file:
            header: dict[str, Any] = json.loads(file.readline(MAX_HEADER))
            if header["format"] != FORMAT:
                raise ValueError("another format")
            images = {name: restored(_read(file, entry, np.uint8, (3,))) for name, entry in header["images"].items()}
            masks = {name: _read(file, entry, np.bool_, ()) for name, entry in header["masks"].items()}
        pts, captured, origin = (header[f"{name}_seconds"] for name in ("pts", "captured_unix", "origin"))
        return MultiViewFrame(int(header["index"]), float(pts), images, masks, captured), float(origin)
    except (OSError, ValueError, KeyError, TypeError, zstandard.ZstdError) as error:
        raise CaptureError(
            f"The pictures {path} are damaged ({error}). Without them the stream cannot be resumed; begin another one."
        ) from None


def residuals(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """A picture ``[H, W, 3]`` as residuals ``[3, H, W]`` (Note [Residuals])."""
    planes = image.transpose(2, 0, 1).copy()
    planes[0] -= planes[1]
    planes[2] -= planes[1]
    planes[:, :, 1:] = planes[:, :, 1:] - planes[:, :, :-1]
    planes[:, 1:] = planes[:, 1:] - planes[:, :-1]
    return planes


def restored(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The picture ``[H, W, 3]`` of residuals, which are given in an array of the picture's shape."""
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
