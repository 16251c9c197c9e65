# SPDX-License-Identifier: Apache-2.0
"""Random-access bytes, in memory or in a file that is read on demand; and the room that a disk has left."""

import os
import shutil
import weakref
from io import FileIO
from pathlib import Path
from typing import Protocol, Self

from structgstream.errors import StorageError, StreamError


class ByteSource(Protocol):
    """Length and slices, which ``bytes``, ``memoryview``, :class:`FileBytes` and :class:`ByteSlice` have."""

    def __len__(self) -> int: ...

    def __getitem__(self, key: slice, /) -> bytes | memoryview: ...


class FileBytes:
    """A file whose slices are read on demand.

    The length is that at opening; bytes appended later by a running reconstruction are not visible. Thread-safe. The
    file is closed by :meth:`close` or when the object is collected.

    Args:
        file: its path, or an open descriptor, which is closed with this object.
        name: of the file, for messages; None for the path.

    Raises:
        StreamError: it cannot be read; on slicing also if it is closed or has become shorter.
    """

    def __init__(self, file: Path | str | int, *, name: str | None = None) -> None:
        self._name = str(file) if name is None else name
        try:
            self._file = FileIO(file)
            # The finalizer refers to the file, not to this object, so that an unclosed reader leaks no open file.
            self._finalizer = weakref.finalize(self, self._file.close)
            self._size = self._file.seek(0, 2)
        except OSError as error:
            raise StreamError(f"Cannot read {self._name} ({error.strerror}); expected a stream file.") from error

    def __len__(self) -> int:
        return self._size

    def __getitem__(self, key: slice, /) -> bytes:
        start, stop, _ = key.indices(self._size)
        pieces = []
        try:
            while start < stop:  # The operating system may return fewer bytes per call.
                if not (piece := os.pread(self._file.fileno(), stop - start, start)):
                    raise StreamError(
                        f"Cannot read {self._name}: it has become shorter since it was opened; open it again."
                    )
                pieces.append(piece)
                start += len(piece)
        except OSError as error:
            raise StreamError(f"Cannot read {self._name} ({error.strerror}); it could be read before.") from error
        except ValueError as error:
            raise StreamError(f"Cannot read {self._name}: it has been closed; open it again.") from error
        return pieces[0] if len(pieces) == 1 else b"".join(pieces)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *raised: object) -> None:
        self.close()

    def close(self) -> None:
        """Closes the file. A second call does nothing."""
        self._finalizer()


class ByteSlice:
    """A view of the bytes from ``start`` to ``end``."""

    def __init__(self, data: ByteSource, start: int, end: int) -> None:
        self._data = data
        self._start = start
        self._size = max(min(end, len(data)) - start, 0)

    def __len__(self) -> int:
        return self._size

    def __getitem__(self, key: slice, /) -> bytes | memoryview:
        start, stop, _ = key.indices(self._size)
        return self._data[self._start + start : self._start + max(stop, start)]


MARGIN_PACKETS = 3
"""A packet is written only while this many of the largest one so far fit, besides what closing the stream takes."""


def free_bytes(path: Path) -> int | None:
    """What an ordinary user may still write to the disk of ``path``, which may not exist yet; None if not known."""
    try:
        return shutil.disk_usage(next(each for each in (path, *path.absolute().parents) if each.exists())).free
    except OSError:
        return None


def check_room(free: int | None, *, largest: int, closing: int, where: str, frames: int) -> None:
    """Check that the next packet and the end of the stream fit. Raises StorageError if they may not.

    All sizes are in bytes: ``free``, what is left on the disk (None if unknown); ``largest``, the largest packet so far
    or the next one; ``closing``, what closing the stream writes.
    """
    needed = MARGIN_PACKETS * largest + closing
    if free is not None and free < needed:
        raise StorageError(
            f"The disk of {where} is nearly full: {free} bytes are left, and {needed} are needed to finish the stream. "
            f"It was closed after {frames} frames, all of which are safe; make room and continue with --resume."
        )
