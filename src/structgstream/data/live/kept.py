# SPDX-License-Identifier: Apache-2.0
"""The pictures that a resumed live run needs, which no camera sends twice: of a period's first and of the last frames.

They lie in ``OUT.live`` beside the stream: a frame's file is complete before the frame is handed out, so whenever the
run ends, those of the frame before the first one that the stream lacks are there. What is older than :data:`LAST`
frames is removed, so the folder does not grow; while no picture shows anything, the last two frames that did stay, and
those after them are stored as black.
"""

import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from structgstream.data.live.picture_file import read_pictures, write_pictures
from structgstream.errors import CaptureError, StorageError
from structgstream.frames import MIN_CAMERAS, MultiViewFrame
from structgstream.owned_folders import check_owned, own_folder

LAST = 3
"""Frames besides the period's first: one that is fitted, the one before it, and one that may have been read ahead."""
PURPOSE = "pictures that a live stream needs to be resumed"
NAME = re.compile(r"frame-(\d{8})\.pictures")


def kept_folder(stream: Path) -> Path:
    """The folder beside a stream."""
    return stream.with_name(f"{stream.name}.live")


class KeptFrames:
    """The folder of a live run.

    Args:
        folder: is made when the first frame is kept.
        cameras: those whose pictures are kept: of held-out ones none is needed.
        resume: whether what is there is of this stream; else it is removed when the first frame is kept.

    Raises:
        StorageError: the folder cannot be used, or holds files of others.
    """

    def __init__(self, folder: Path, *, cameras: tuple[str, ...], resume: bool) -> None:
        self._folder, self._cameras = folder, cameras
        self._first, self._last = frozenset({0}), LAST
        self._resume = resume
        check_owned(folder, PURPOSE)

    def need(self, *first: int, last: int) -> None:
        """From now on the frames ``first`` are kept, and so are ``last`` frames before the one that is fitted."""
        self._first, self._last = frozenset(first), max(last + LAST - 1, LAST)

    def keep(self, frame: MultiViewFrame, *, origin_seconds: float) -> None:
        """Keeps a frame's pictures, and removes those that are no longer needed.

        Args:
            frame: the frame.
            origin_seconds: the common clock at presentation time 0.

        Raises:
            StorageError: they cannot be written.
        """
        images = {name: image for name, image in frame.images.items() if name in self._cameras}
        if len(frame.showing(self._cameras)) < min(MIN_CAMERAS, len(self._cameras)):  # a held frame, of any length
            images = {name: np.zeros_like(image) for name, image in images.items()}
        masks = {name: mask for name, mask in frame.masks.items() if name in self._cameras}
        own_folder(self._folder, PURPOSE)
        if not self._resume:
            self._remove(self._files())
            self._resume = True
        kept = replace(frame, images=images, masks=masks)
        write_pictures(self._path(frame.index), kept, sync=True, origin_seconds=origin_seconds)
        oldest = frame.index - self._last + 1
        files = self._files().items()
        self._remove({n: file for n, file in files if n > frame.index or (n < oldest and n not in self._first)})

    def following(self, start: int) -> Iterator[MultiViewFrame]:
        """The kept frames from number ``start`` on, without a gap; none if the next frame is ``start``.

        Raises:
            CaptureError: a file is damaged, or frame ``start`` is in the past and not kept.
        """
        index = start
        while self._path(index).is_file():
            yield self._read(index)[0]
            index += 1
        if index == start and start > 0 and not self._path(start - 1).is_file():
            raise CaptureError(
                f"The pictures of frame {start} are not in {self._folder}, and no camera sends them again, so the "
                "stream cannot be resumed; restore the folder, or begin another stream."
            )

    def last(self) -> tuple[float, float] | None:
        """Presentation time of the last kept frame, and the common clock at presentation time 0; None without any.

        Raises:
            CaptureError: its file is damaged.
        """
        files = self._files()
        if not files:
            return None
        frame, facts = self._read(max(files))
        return frame.pts_seconds, float(facts["origin_seconds"])

    def _read(self, index: int) -> tuple[MultiViewFrame, dict[str, float]]:
        try:
            return read_pictures(self._path(index))
        except CaptureError as error:
            raise CaptureError(f"{error} Without them the stream cannot be resumed; begin another one.") from None

    def _path(self, index: int) -> Path:
        return self._folder / f"frame-{index:08d}.pictures"

    def _files(self) -> dict[int, Path]:
        found = self._folder.iterdir() if self._folder.is_dir() else ()
        return {int(match[1]): file for file in found if (match := NAME.fullmatch(file.name))}

    def _remove(self, files: dict[int, Path]) -> None:
        try:
            for file in files.values():
                file.unlink(missing_ok=True)
        except OSError as error:
            raise StorageError(f"{error.filename} cannot be removed ({error.strerror}).") from None
