# SPDX-License-Identifier: Apache-2.0
"""Packet sinks: a file, crash-safe, or memory; and streams of segments to continue."""

import io
import math
import os
from contextlib import nullcontext, suppress
from pathlib import Path
from typing import BinaryIO

from structgstream.atomic_files import append_durably, lock_file, sync_folder
from structgstream.codec.container.byte_source import ByteSlice, ByteSource, FileBytes, check_room, free_bytes
from structgstream.codec.container.records import (
    INDEX_ENTRY,
    PREFIX,
    RECORD_TYPES,
    Period,
    RecordType,
    check_prefix,
    incomplete_reason,
    may_be_prefix,
    pack_index,
    packed,
    period_at,
    prefix,
    read_record,
)
from structgstream.codec.contents import LOST, PacketInfo, Packets, PacketSearch, Standing
from structgstream.codec.packets import Packet, PacketKind, StreamHeader, pack_header, sound_record
from structgstream.codec.reader import StreamReader
from structgstream.codec.segments.recovery import find
from structgstream.codec.segments.sink import Clocks, SegmentsOptions, SegmentsSink
from structgstream.codec.segments.store import Store
from structgstream.codec.segments.stored_bytes import StoredBytes
from structgstream.errors import StorageError, StreamError


class _RecordSink:
    """Appends records to an unbuffered binary file and keeps the index.

    ``_end`` advances in one step, after a record is completely on the disk. An exception at any time, Ctrl-C included,
    leaves at most extra bytes after ``_end``, which the next write or :meth:`close` replaces. What begins another
    period is written together with its first packet, so that no file ends with it in an orderly way.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._file: BinaryIO | None = None  # while the sink is open
        self._header_bytes = self._largest = 0
        self._end = 0
        self._entries = bytearray()  # packed INDEX_ENTRYs; those with an offset of _end or more were interrupted
        self._period = 0
        self._init = b""  # of the period that the next packet begins
        self._failed = False

    def open(self, header: StreamHeader) -> int:
        """Write the init record; returns the bytes it took."""
        start = prefix(periods=header.periods, sound=header.sound is not None)
        self._header_bytes = self._append(start + packed(RecordType.INIT, pack_header(header)))
        return self._header_bytes

    def begin(self, header: StreamHeader) -> int:
        """Begin another period with the next packet; its init record is written with that.

        Raises:
            StreamError: the header's description is too long.
        """
        self._init = packed(RecordType.INIT, pack_header(header), period=self._period + 1)
        return len(self._init)

    def write(self, packet: Packet) -> int:
        """Append one packet; returns the bytes it took.

        Raises:
            StorageError: the packet cannot be written, or the disk is nearly full; earlier packets stay.
        """
        assert packet.kind is PacketKind.KEY or not self._init, "a period begins with a key packet"
        kind, period = RECORD_TYPES[packet.kind], self._period + bool(self._init)
        record = packed(kind, packet.payload, period=period) + sound_record(packet)
        self._largest = max(self._largest, len(record))
        check_room(
            self._free_bytes(),
            largest=self._largest,
            closing=max(self._header_bytes, len(self._init)) + len(self._entries) + 2 * INDEX_ENTRY.size,
            where=self._name,
            frames=self._frames(),
        )
        if self._init:
            self._entries += INDEX_ENTRY.pack(packet.index, RecordType.INIT, self._end)
        self._entries += INDEX_ENTRY.pack(packet.index, kind, self._end + len(self._init))
        self._append(self._init + record)
        self._init, self._period = b"", period
        return len(record)

    def close(self) -> None:
        """Write the index, unless a write has failed. A second call does nothing.

        Raises:
            StorageError: no room for the index; all frames are safe.
        """
        try:
            if self._file is not None and not self._failed:
                self._frames()
                self._append(pack_index(INDEX_ENTRY.iter_unpack(self._entries), self._end))
                self._file.truncate(self._end)
        finally:
            self._file = None

    def _free_bytes(self) -> int | None:
        """Room on the disk; None if that is not known."""
        return None

    def _frames(self) -> int:
        """The number of whole packets; entries of an interrupted write are forgotten."""
        size = INDEX_ENTRY.size
        while self._entries and INDEX_ENTRY.unpack(self._entries[-size:])[2] >= self._end:
            del self._entries[-size:]
        return INDEX_ENTRY.unpack(self._entries[-size:])[0] + 1 if self._entries else 0

    def _append(self, data: bytes) -> int:
        assert self._file is not None, "open() comes first"
        try:
            append_durably(self._file, data, end=self._end)
        except OSError as error:
            self._failed = True
            raise StorageError(
                f"Cannot write {len(data)} bytes to {self._name} ({error.strerror or error}). The {self._frames()} "
                "frames before are safe in it; make room and continue with --resume."
            ) from error
        self._end += len(data)
        return len(data)


def readable_part(data: ByteSource, *, name: str) -> int | None:
    """End of the last whole packet, before the index; None if there is no whole packet. Raises StreamError if it is no
    stream, of another major version, or damaged before whole frames, which writing would destroy.

    In a stream with sound, a packet counts when the sound record after it is whole: both are written at once.
    """
    if may_be_prefix(data[: PREFIX.size + 1]):
        return None  # Cut within the prefix, or empty.
    check_prefix(data, name)
    if read_record(data, PREFIX.size) is None:
        reason = incomplete_reason(data, PREFIX.size)
        following = PacketSearch(data).next(PREFIX.size, Standing(PREFIX.size, 0, -math.inf))
        if "damaged" in reason or following is not None:
            raise StreamError(f"Cannot continue {name}: {reason}. Keep a copy; then start again with --overwrite.")
        return None
    reader = StreamReader(data, name=name)
    # A crash cannot leave whole frames after a damaged one; a failing disk can.
    frames = reader.damage[0].frames.start if reader.damage else len(reader)
    if frames and reader.header.sound is not None and reader.sound(frames - 1) is None:
        frames -= 1
    last = reader.packets.at(frames - 1) if frames else reader.periods[0]
    end = last.offset + last.bytes
    if reader.damage:
        raise StreamError(
            f"Cannot continue {name}: {incomplete_reason(data, reader.damage[0].offset)}, and continuing would "
            f"overwrite the whole frames after it. Keep a copy, then truncate the file to {end} bytes and use --resume "
            "to fit them again."
        )
    return end if frames else None


class FileSink(_RecordSink):
    """A stream file. Every packet is on the disk when ``write`` returns; a failed write is truncated.

    From :meth:`open` to :meth:`close` no other sink, of this process or another, can write to the file.
    """

    def __init__(self, path: Path | str, *, overwrite: bool = False) -> None:
        super().__init__(str(Path(path)))
        self.path = Path(path)
        self._overwrite = overwrite
        self._resumed: tuple[int, StreamReader] | None = None
        self._size = 0  # of the file that is resumed

    @classmethod
    def resume(cls, path: Path | str) -> tuple["FileSink", StreamReader | None]:
        """A sink that continues a file after its last whole packet, and a reader of the existing packets.

        The reader is None if there is no whole packet: the stream then restarts at frame 0, because the static fields
        in the init record match only the lost dynamic fields of frame 0. The file is not changed before :meth:`open`.

        Raises:
            StreamError: the file is no stream, or is damaged so that it cannot be continued.
        """
        sink = cls(path, overwrite=True)
        data: ByteSource = FileBytes(path) if sink.path.exists() else b""
        sink._size = len(data)
        if (end := readable_part(data, name=str(path))) is None:
            return sink, None
        reader = StreamReader(ByteSlice(data, 0, end), name=str(path))
        sink._resumed = (end, reader)
        return sink, reader

    def check_unused(self) -> None:
        """Find out before a long fit what :meth:`open` would find after it.

        Raises:
            StorageError: another sink writes to the file now.
        """
        with suppress(OSError), self.path.open("rb+") as file:  # open() reports what cannot be opened.
            self._lock(file)

    def open(self, header: StreamHeader) -> int:
        """Create the file and write the init record, or continue a resumed file, which already has one.

        Raises:
            StorageError: it exists and may not be overwritten, is written to by another sink or has been since it was
                resumed, or cannot be written.
        """
        if self.path.exists() and not self._overwrite:
            raise StorageError(
                f"{self.path} exists; continue it with --resume, replace it with --overwrite, or choose another name."
            )
        try:
            self._file = self._opened()
            if self._resumed is not None:
                self._continue_at(*self._resumed)
                self._file.truncate(self._end)
                return 0
            if os.stat(self._file.fileno()).st_size:  # Devices have no size, and cannot be truncated.
                self._file.truncate(0)
            sync_folder(self.path.parent)
        except OSError as error:
            raise StorageError(
                f"Cannot open {self.path} for writing ({error.strerror}); choose another place or mend its permissions."
            ) from error
        return super().open(header)

    def close(self) -> None:
        """As of every sink; the file is closed in any case."""
        with self._file or nullcontext():
            super().close()

    def _continue_at(self, end: int, reader: StreamReader) -> None:
        """Continue after byte ``end`` of the file with the packets of ``reader``."""
        begun = {period.first_frame: period for period in reader.periods[1:]}
        for info in reader.packets:
            if (period := begun.get(info.index)) is not None:
                self._entries += INDEX_ENTRY.pack(info.index, RecordType.INIT, period.offset)
            self._entries += INDEX_ENTRY.pack(info.index, RECORD_TYPES[info.kind], info.offset)
        self._period, self._header_bytes = reader.periods[-1].number, reader.periods[-1].bytes
        self._end = end

    def _free_bytes(self) -> int | None:
        return free_bytes(self.path)

    def _opened(self) -> BinaryIO:
        """The file, locked before anything in it is changed."""
        self.path.touch()  # "w" would empty a file that another process writes.
        file: BinaryIO = self.path.open("rb+", buffering=0)  # type: ignore[assignment]
        try:
            self._lock(file)
            if self._resumed is not None and os.stat(file.fileno()).st_size != self._size:
                raise StorageError(
                    f"{self.path} has been written to by another process since it was read; give the command again."
                )
        except BaseException:
            file.close()
            raise
        return file

    def _lock(self, file: BinaryIO) -> None:
        if not lock_file(file):
            raise StorageError(f"Another process writes to {self.path}; wait for its end, or choose another name.")


class MemorySink(_RecordSink):
    """A stream in memory; :attr:`data` equals the content of a file."""

    def __init__(self) -> None:
        super().__init__("memory")
        self._buffer = io.BytesIO()

    @property
    def data(self) -> bytes:
        """Everything written so far."""
        return self._buffer.getvalue()

    def open(self, header: StreamHeader) -> int:
        """Write the init record; returns the bytes it took."""
        self._file = self._buffer
        return super().open(header)


class StoredPackets(Packets):
    """All packets; of those that have left the window size and kind are known, and the time as interpolated."""

    def __init__(self, stored: StoredBytes, found: Packets, *, name: str) -> None:
        super().__init__(stored, name)
        self._stored = stored
        self.offsets, self.whole = found.offsets, len(stored.sizes)

    def at(self, index: int) -> PacketInfo:
        """Facts of the packet of a frame."""
        if self.offsets[index] != LOST:
            return super().at(index)
        stored = self._stored
        return PacketInfo(stored.kinds[index], index, stored.seconds[index], LOST, stored.sizes[index], {})


class StoredSegments(StreamReader):
    """The existing frames of a stream of segments, some of which may have left the window; its packets are of all."""

    def __init__(self, stored: StoredBytes, *, name: str) -> None:
        super().__init__(stored, name=name, gone=stored.gone)
        self._periods = stored.periods
        self.packets = StoredPackets(stored, self.packets, name=name)

    def period(self, index: int) -> Period:
        """The period of a frame, also of one that has left the window."""
        return self._periods[period_at(self._periods, index)]


def resume_segments(
    store: Store, *, options: SegmentsOptions | None = None, clocks: Clocks | None = None
) -> tuple[SegmentsSink, StoredSegments | None]:
    """A sink that continues a stream of segments after its last written frame, and its existing frames; None if there
    is no whole one: the stream then begins again. Nothing is changed before the sink is opened. Raises StreamError if
    the stream is damaged so that it cannot be continued."""
    found = find(store)
    sink = SegmentsSink(store, overwrite=True, options=options, clocks=clocks, found=found)
    if found is None:
        return sink, None
    held = dict(found.files)
    held |= {part.file: record for part, record in zip(found.manifest.parts, found.records, strict=True)}
    return sink, StoredSegments(StoredBytes(store, found.manifest, held=held, check=True), name=store.name)
