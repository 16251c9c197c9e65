# SPDX-License-Identifier: Apache-2.0
"""A possibly growing stream file for the server, which does not decode packets."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from structgstream.codec.container.byte_source import ByteSource, FileBytes
from structgstream.codec.container.records import (
    PREFIX,
    RecordType,
    check_prefix,
    footer_offset,
    incomplete_reason,
    read_head,
)
from structgstream.errors import StreamError

PIECE_BYTES = 256 * 1024


@dataclass(frozen=True)
class StreamFile:
    """The file at ``path``; every method opens it anew, because it may be replaced at any time."""

    path: Path

    def opened(self) -> FileBytes:
        """The open file at its present length.

        Raises:
            StreamError: it cannot be read.
        """
        return FileBytes(self.path)

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
        if not self.path.exists():
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
    if head is None or head[0] != RecordType.INIT:
        raise StreamError(f"No frame of {name} can be decoded: {incomplete_reason(data, PREFIX.size)}.")


def pieces(data: ByteSource, wanted: range) -> Iterator[bytes | memoryview]:
    """The bytes ``wanted`` of ``data``, in pieces."""
    for start in range(wanted.start, wanted.stop, PIECE_BYTES):
        yield data[start : min(start + PIECE_BYTES, wanted.stop)]
