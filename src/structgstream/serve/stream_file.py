# SPDX-License-Identifier: Apache-2.0
"""The bytes of a stream file that may grow, or of a folder of segments, and pages written from them."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from structgstream.atomic_files import atomic_write
from structgstream.codec.container.byte_source import ByteSource, FileBytes
from structgstream.codec.container.records import (
    PREFIX,
    RecordType,
    check_prefix,
    footer_offset,
    incomplete_reason,
    read_head,
)
from structgstream.codec.segments.manifest import MANIFEST
from structgstream.codec.segments.stored_bytes import StoredBytes, is_segments, open_segments
from structgstream.errors import StorageError, StreamError
from structgstream.serve.pages import bundle, linked_page, single_page

PIECE_BYTES = 2**20


@dataclass(frozen=True)
class StreamFile:
    """The file or folder at ``path``; every method opens it anew, because it may be replaced at any time."""

    path: Path

    def opened(self) -> FileBytes | StoredBytes:
        """The open stream at its present length.

        Raises:
            StreamError: it cannot be read, or its first frames have been removed from the window.
        """
        if not is_segments(self.path):
            return FileBytes(self.path)
        stored = open_segments(self.path)
        if stored.gone:
            raise StreamError(
                f"{self.path} stores a window of frames, and the first frames have been removed; it cannot be shown as "
                "one file. Show it with structgstream serve."
            )
        return stored

    def state(self) -> tuple[int, bool]:
        """Length of the file in bytes, and whether it is complete (has its index).

        Raises:
            StreamError: it cannot be read.
        """
        with self.opened() as data:
            return len(data), footer_offset(data) is not None

    def check(self) -> None:
        """Check that the file has a whole header, see :func:`check_has_header`."""
        with self.opened() as data:
            check_has_header(data, str(self.path))

    def has_header(self) -> bool:
        """Whether the file exists and has a whole header.

        Raises:
            StreamError: it is no stream, or of another version.
        """
        manifest = self.path if self.path.name == MANIFEST else self.path / MANIFEST
        if not (manifest if is_segments(self.path) else self.path).exists():
            return False
        with self.opened() as data:
            if len(data) < PREFIX.size:
                return False
            check_prefix(data, str(self.path))
            return read_head(data, PREFIX.size) is not None


def check_has_header(data: ByteSource, name: str) -> None:
    """Check that a stream has a whole header.

    Raises:
        StreamError: it is empty, no stream, of another version, or truncated within its header.
    """
    if not len(data):
        raise StreamError(f"{name} is empty; expected a stream made by structgstream reconstruct.")
    check_prefix(data, name)
    head = read_head(data, PREFIX.size)
    if head is None or head.type != RecordType.INIT:
        raise StreamError(f"No frame of {name} can be decoded: {incomplete_reason(data, PREFIX.size)}.")


def write_page(path: Path, stream: StreamFile) -> int:
    """Writes one HTML page that contains the player and the stream at its present length.

    Returns:
        Bytes of the page.

    Raises:
        PlayerError: the stream is too long for a page, or the installation lacks the player.
        StreamError: no frame of the stream can be decoded.
        StorageError: the page cannot be written.
    """
    with stream.opened() as data:
        check_has_header(data, str(stream.path))
        page = single_page(stream.path.stem, module=bundle(), stream=data)
    atomic_write(path, page, new_folder=True)
    return len(page)


def write_site(folder: Path, stream: StreamFile) -> int:
    """Writes ``index.html``, ``player.js`` and ``stream.sgs`` into a folder; a web server needs nothing else.

    Returns:
        Bytes of the three files.

    Raises:
        PlayerError: the installation lacks the player.
        StreamError: no frame of the stream can be decoded.
        StorageError: a file cannot be written, or would replace the stream itself.
    """
    stream.check()
    copy = folder / "stream.sgs"
    if copy.exists() and copy.samefile(stream.path):
        raise StorageError(f"{copy} is the stream itself; name another folder.")
    small = {
        "index.html": linked_page(stream.path.stem, stream="stream.sgs").encode(),
        "player.js": bundle().encode(),
    }
    for name, content in small.items():
        atomic_write(folder / name, content, new_folder=True)
    with stream.opened() as data:
        atomic_write(copy, _pieces(data), new_folder=True)
        return sum(map(len, small.values())) + len(data)


def _pieces(data: ByteSource) -> Iterator[bytes | memoryview]:
    for start in range(0, len(data), PIECE_BYTES):
        yield data[start : min(start + PIECE_BYTES, len(data))]
