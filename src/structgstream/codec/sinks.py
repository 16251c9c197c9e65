# SPDX-License-Identifier: Apache-2.0
"""Where packets go: a file that is never left damaged, or memory."""

import io
import os
import struct
from pathlib import Path
from typing import BinaryIO

from structgstream.codec.header import packed_header
from structgstream.codec.packets import Packet, PacketKind, StreamHeader
from structgstream.codec.reader import StreamReader, readable_part
from structgstream.codec.records import RecordType, packed, prefix
from structgstream.errors import StorageError

INDEX_ENTRY = struct.Struct("<IBQ")  # frame index, record type, offset
FOOTER = struct.Struct("<Q8s")
FOOTER_MAGIC = b"SGSINDEX"


class _Writer:
    """Appends records to a binary file and keeps the index."""

    def __init__(self, file: BinaryIO, name: str) -> None:
        self._file = file
        self._name = name
        self._end = 0
        self._entries: list[tuple[int, int, int]] = []

    def continue_at(self, end: int, entries: list[tuple[int, int, int]]) -> None:
        self._end, self._entries = end, list(entries)

    def append(self, data: bytes) -> int:
        try:
            self._file.seek(self._end)
            self._file.write(data)
            self._file.flush()
            self._sync()
        except OSError as error:
            self._restore()
            raise StorageError(
                f"Cannot write {len(data)} bytes to {self._name} ({error.strerror or error}). The {len(self._entries)} "
                "frames before are safe in it; make room and continue with --resume."
            ) from error
        self._end += len(data)
        return len(data)

    def _sync(self) -> None:
        try:
            os.fsync(self._file.fileno())
        except io.UnsupportedOperation:
            pass  # A file in memory has nothing to sync.

    def _restore(self) -> None:
        """Cut what a failed write left behind; if even that fails, readers stop at the damaged record anyway."""
        try:
            self._file.truncate(self._end)
        except OSError:
            pass

    def open(self, header: StreamHeader) -> int:
        return self.append(prefix() + packed(RecordType.INIT, packed_header(header)))

    def write(self, packet: Packet) -> int:
        kind = RecordType.KEY if packet.kind is PacketKind.KEY else RecordType.DELTA
        offset = self._end
        size = self.append(packed(kind, packet.payload))
        self._entries.append((packet.index, int(kind), offset))
        return size

    def finish(self) -> int:
        offset = self._end
        index = b"".join(INDEX_ENTRY.pack(*entry) for entry in self._entries)
        return self.append(packed(RecordType.INDEX, index) + FOOTER.pack(offset, FOOTER_MAGIC))


class FileSink:
    """A stream file. Every packet is on the disk when ``write`` returns; a failed write is cut off again."""

    def __init__(self, path: Path | str, *, overwrite: bool = False) -> None:
        self.path = Path(path)
        self._overwrite = overwrite
        self._writer: _Writer | None = None
        self._file: BinaryIO | None = None

    def open(self, header: StreamHeader) -> int:
        """Create the file and write the init record.

        Raises:
            StorageError: it exists and may not be overwritten, or cannot be written.
        """
        if self._writer is not None:
            return 0  # Resumed: the header is in the file.
        if self.path.exists() and not self._overwrite:
            raise StorageError(
                f"{self.path} exists; continue it with --resume, replace it with --overwrite, or choose another name."
            )
        self._file = _opened(self.path, "wb+")
        self._writer = _Writer(self._file, str(self.path))
        return self._writer.open(header)

    @classmethod
    def resume(cls, path: Path | str) -> tuple["FileSink", StreamReader | None]:
        """A sink that continues a file after its last whole packet, and the reader of what is there.

        The reader is None when not even the init record is whole: the stream then starts again from nothing.
        """
        sink = cls(path, overwrite=True)
        if not sink.path.exists():
            return sink, None
        data = sink.path.read_bytes()
        end = readable_part(data)
        if end is None:
            return sink, None
        reader = StreamReader(data[:end], name=str(path))
        sink._file = _opened(sink.path, "rb+")
        sink._file.truncate(end)
        sink._writer = _Writer(sink._file, str(path))
        sink._writer.continue_at(end, [(p.index, int(p.kind) + 1, p.offset) for p in reader.packets])
        return sink, reader

    def write(self, packet: Packet) -> int:
        """Append one packet; returns the bytes it took.

        Raises:
            StorageError: the disk is full or gone; what was written before stays.
        """
        assert self._writer is not None, "open() comes before write()"
        return self._writer.write(packet)

    def close(self) -> None:
        """Write the index and close the file."""
        if self._writer is None or self._file is None:
            return
        try:
            self._writer.finish()
        finally:
            self._file.close()
            self._writer = self._file = None


class MemorySink:
    """The same bytes in memory; :attr:`data` is what a file would hold."""

    def __init__(self) -> None:
        self._buffer = io.BytesIO()
        self._writer = _Writer(self._buffer, "memory")

    @property
    def data(self) -> bytes:
        """Everything written so far."""
        return self._buffer.getvalue()

    def open(self, header: StreamHeader) -> int:
        """Write the init record."""
        return self._writer.open(header)

    def write(self, packet: Packet) -> int:
        """Append one packet; returns the bytes it took."""
        return self._writer.write(packet)

    def close(self) -> None:
        """Write the index."""
        self._writer.finish()


def _opened(path: Path, mode: str) -> BinaryIO:
    try:
        return path.open(mode)  # type: ignore[return-value]
    except OSError as error:
        raise StorageError(f"Cannot open {path} for writing ({error.strerror}).") from error
