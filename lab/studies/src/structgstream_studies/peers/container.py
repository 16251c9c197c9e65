# SPDX-License-Identifier: Apache-2.0
"""The file of a peer method: this project's records (with CRC, readable when truncated) with named arrays.

::

    "\\x89SGP\\r\\n\\x1a\\n"  version u16 u16 | INIT record: a stream header, codec = the method's name
                                         | KEY or DELTA record: index u32, pts f64, array, array, ...
                                         | INDEX record: number of frames u32 -- the run came to its end
    array = name length u8, type u8, dimensions u8, 0 u8, name, sizes u32 ..., numbers (little-endian, not compressed)
"""

import math
import os
import struct
from collections.abc import Callable, Iterator
from contextlib import suppress
from io import FileIO
from pathlib import Path
from typing import Any, Generic

import numpy as np
import torch
from numpy.typing import NDArray

from structgstream.codec.container.byte_source import ByteSource
from structgstream.codec.container.records import (
    PREFIX,
    Period,
    RecordType,
    incomplete_reason,
    packed,
    read_record,
    scan_records,
)
from structgstream.codec.contents import PacketInfo
from structgstream.codec.packets import Packet, PacketKind, StreamHeader, pack_header, unpack_header
from structgstream.codec.scene_coder import FRAME
from structgstream.errors import StorageError, StreamError
from structgstream.session.pipeline import State
from structgstream_studies.peers.method import Arrays, PeerMethod

MAGIC = b"\x89SGP\r\n\x1a\n"
MAJOR, MINOR = 1, 0
ARRAY = struct.Struct("<BBBB")
COUNT = struct.Struct("<I")
MAX_DIMENSIONS = 4
MAX_ELEMENTS = 2**31 - 1
_DTYPES = {0: np.dtype("<f4"), 1: np.dtype("<f2"), 2: np.dtype("<u1"), 3: np.dtype("<i8")}
_CODES = {dtype: code for code, dtype in _DTYPES.items()}
_KINDS = {RecordType.KEY: PacketKind.KEY, RecordType.DELTA: PacketKind.DELTA}
_TYPES = {kind: record for record, kind in _KINDS.items()}


def packed_array(name: str, value: NDArray[Any]) -> bytes:
    """One named array as bytes.

    Raises:
        StreamError: a type, a name or a number of dimensions that the format does not hold.
    """
    code = _CODES.get(value.dtype.newbyteorder("<") if value.dtype.itemsize > 1 else value.dtype)
    text = name.encode("ascii", errors="replace")
    if code is None or not 0 < len(text) < 256 or value.ndim > MAX_DIMENSIONS:
        raise StreamError(f"Array {name!r} ({value.dtype}, {value.ndim} dimensions) has no place in a peer's file.")
    head = ARRAY.pack(len(text), code, value.ndim, 0) + text + struct.pack(f"<{value.ndim}I", *value.shape)
    return head + np.ascontiguousarray(value, dtype=_DTYPES[code]).tobytes()


def unpacked_arrays(payload: bytes, start: int, *, where: str) -> tuple[Arrays, dict[str, int]]:
    """The arrays from byte ``start`` on, and the bytes that each takes. Nothing is allocated before it is known to fit.

    Raises:
        StreamError: the payload contradicts the format.
    """
    arrays: Arrays = {}
    sizes: dict[str, int] = {}
    while start < len(payload):
        if start + ARRAY.size > len(payload):
            raise StreamError(f"{where} ends within the head of an array.")
        length, code, dimensions, _ = ARRAY.unpack_from(payload, start)
        shape_at = start + ARRAY.size + length
        data = shape_at + 4 * dimensions
        if code not in _DTYPES or dimensions > MAX_DIMENSIONS or not length or data > len(payload):
            raise StreamError(f"{where} holds an array (type {code}, {dimensions} dimensions) of no known form.")
        name = payload[start + ARRAY.size : shape_at].decode("ascii", errors="replace")
        shape = struct.unpack_from(f"<{dimensions}I", payload, shape_at)
        end = data + math.prod(shape) * _DTYPES[code].itemsize
        if end > len(payload) or math.prod(max(size, 1) for size in shape) > MAX_ELEMENTS:
            raise StreamError(f"{where} states {shape} numbers for array {name!r}, more than it holds.")
        if name in arrays:
            raise StreamError(f"{where} holds array {name!r} twice.")
        found = np.frombuffer(payload, dtype=_DTYPES[code], count=math.prod(shape), offset=data)
        arrays[name] = found.reshape(shape).astype(found.dtype.newbyteorder("="))
        sizes[name] = end - start
        start = end
    return arrays, sizes


class PeerReader(Generic[State]):
    """A peer's file, whole or cut anywhere.

    Args:
        data: its bytes.
        method: gives the method that decodes, from the header.
        name: of the file, for messages.

    Attributes:
        header: the init record; ``codec`` is the method's name, ``config`` its configuration.
        packets: every whole frame before the first cut or damage.
        complete: whether the run that wrote the file finished.
        cut_reason: why the file is not complete.
        header_bytes: length of everything before the first frame.
        total_bytes: length of the file.
        end: offset of the byte after the last whole frame.

    Raises:
        StreamError: not a peer's file, another major version, or records that contradict each other.
    """

    def __init__(
        self, data: ByteSource, method: Callable[[StreamHeader], PeerMethod[State, Any]], *, name: str = "The file"
    ) -> None:
        self._data, self._name = data, name
        check_prefix(data, name)
        init = read_record(data, PREFIX.size)
        if init is None or init.type != RecordType.INIT:
            raise StreamError(f"Nothing of {name} can be shown: {incomplete_reason(data, PREFIX.size)}.")
        self.header = unpack_header(init.payload)
        self.method = method(self.header)
        self.header_bytes = self.end = init.end
        self.total_bytes = len(data)
        self.complete = False
        self.packets: list[PacketInfo] = []
        end = init.end
        for record in scan_records(data, init.end):
            end = record.end
            if record.type == RecordType.INDEX:
                self.complete = True
                break
            if record.type in _KINDS:
                self.packets.append(self._info(record.payload, record.type, record.offset, record.end))
                self.end = record.end
        self.cut_reason = None if self.complete else incomplete_reason(data, end)

    def _info(self, payload: bytes, kind: int, offset: int, end: int) -> PacketInfo:
        index = len(self.packets)
        if len(payload) < FRAME.size:
            raise StreamError(f"Frame {index} of {self._name} is too short.")
        number, pts_seconds = FRAME.unpack_from(payload)
        if number != index:
            raise StreamError(f"{self._name} has frame {number} where frame {index} belongs.")
        if not math.isfinite(pts_seconds) or (index and pts_seconds <= self.packets[-1].pts_seconds):
            raise StreamError(f"In {self._name} frame {index} is not presented after the one before it.")
        _, sizes = unpacked_arrays(payload, FRAME.size, where=f"Frame {index} of {self._name}")
        packet_kind = _KINDS[RecordType(kind)]
        if index == 0 and packet_kind is not PacketKind.KEY:
            raise StreamError(f"{self._name} begins with a delta frame; the first must be a key frame.")
        return PacketInfo(packet_kind, index, pts_seconds, offset, end - offset, sizes)

    def __len__(self) -> int:
        return len(self.packets)

    def packet(self, index: int) -> Packet:
        """The packet of frame ``index``.

        Raises:
            StreamError: it was damaged after the file was opened.
        """
        info = self.packets[index]
        record = read_record(self._data, info.offset)
        if record is None:
            raise StreamError(f"Frame {index} of {self._name} is damaged.")
        return Packet(info.kind, index, info.pts_seconds, record.payload, info.field_bytes)

    def arrays(self, index: int) -> Arrays:
        """The arrays of frame ``index``.

        Raises:
            StreamError: it was damaged after the file was opened.
        """
        return arrays_of(self.packet(index), where=f"Frame {index} of {self._name}")

    def header_of(self, index: int) -> StreamHeader:
        """The header, which holds for all frames."""
        return self.header

    def period(self, index: int) -> Period:
        """The only period."""
        return Period(0, 0, PREFIX.size, self.header_bytes - PREFIX.size)

    def group(self, index: int) -> Iterator[Packet]:
        """The packets needed to decode frame ``index``, from the key packet to its own."""
        keys = [info.index for info in self.packets[: index + 1] if info.kind is PacketKind.KEY]
        for number in range(keys[-1], index + 1):
            yield self.packet(number)

    def scene(self, index: int) -> State:
        """Frame ``index`` as the method's state, on the CPU, in normalised units."""
        return next(self.scenes(index))[1]

    def scenes(self, start: int = 0) -> Iterator[tuple[PacketInfo, State]]:
        """Every frame from ``start`` on as the method's state, on the CPU, in normalised units."""
        state: State | None = None
        cpu = torch.device("cpu")
        keys = [info.index for info in self.packets[: start + 1] if info.kind is PacketKind.KEY]
        for info in self.packets[keys[-1] if keys else 0 :]:
            previous = None if info.kind is PacketKind.KEY else state
            state = self.method.restored(self.arrays(info.index), previous, device=cpu)
            if info.index >= start:
                yield info, state


def parse_packet(arrays: Arrays, *, index: int, pts_seconds: float, kind: PacketKind) -> Packet:
    """One frame's arrays as a packet.

    Raises:
        StreamError: the format has no place for one of them.
    """
    blocks = {name: packed_array(name, value) for name, value in arrays.items()}
    payload = FRAME.pack(index, pts_seconds) + b"".join(blocks.values())
    return Packet(kind, index, pts_seconds, payload, {name: len(block) for name, block in blocks.items()})


def arrays_of(packet: Packet, *, where: str) -> Arrays:
    """The arrays in a packet.

    Raises:
        StreamError: the payload contradicts the format.
    """
    return unpacked_arrays(packet.payload, FRAME.size, where=where)[0]


class PeerSink:
    """A peer's file. Every frame is on the disk when :meth:`write` returns.

    Args:
        path: the file; an existing one is replaced, unless it is resumed.
        frames: number of frames of the finished file, which is then marked as complete; None marks none.
        resumed: a reader of the file to continue after its last whole frame.
    """

    def __init__(self, path: Path | str, *, frames: int | None, resumed: "PeerReader[Any] | None" = None) -> None:
        self._path, self._frames, self._resumed = Path(path), frames, resumed
        self._file: FileIO | None = None
        self._count = self._end = 0

    def open(self, header: StreamHeader) -> int:
        """Create the file and write the init record, or go on with a resumed one, which holds its header already.

        Raises:
            StorageError: it cannot be written.
        """
        try:
            self._file = FileIO(self._path, "w" if self._resumed is None else "r+")
        except OSError as error:
            raise StorageError(
                f"Cannot open {self._path} for writing ({error.strerror}); choose another place."
            ) from error
        if self._resumed is None:
            return self._append(PREFIX.pack(MAGIC, MAJOR, MINOR) + packed(RecordType.INIT, pack_header(header)))
        self._count, self._end = len(self._resumed), self._resumed.end
        self._file.truncate(self._end)
        return 0

    def begin(self, header: StreamHeader) -> int:
        """Not possible: a peer's file has one header.

        Raises:
            StorageError: always.
        """
        raise StorageError(f"{self._path} is a peer's file, which has one header; a new period needs a stream file.")

    def write(self, packet: Packet) -> int:
        """Append one frame; returns the bytes that it takes.

        Raises:
            StorageError: the disk is full or gone; what was written before stays.
        """
        size = self._append(packed(_TYPES[packet.kind], packet.payload))
        self._count += 1
        return size

    def close(self) -> None:
        """Close the file, marked as complete if no frame is missing. A second call does nothing."""
        if self._file is None:
            return
        with self._file:
            if self._count == self._frames:
                self._append(packed(RecordType.INDEX, COUNT.pack(self._count)))
        self._file = None

    def _append(self, data: bytes) -> int:
        assert self._file is not None, "open() comes before write()"
        try:
            self._file.seek(self._end)
            rest = memoryview(data)
            while rest:
                rest = rest[self._file.write(rest) :]
            os.fsync(self._file.fileno())
        except OSError as error:
            with suppress(OSError):  # If even this fails, readers stop at the record that is not whole.
                self._file.truncate(self._end)
            raise StorageError(
                f"Cannot write {len(data)} bytes to {self._path} ({error.strerror}); the {self._count} frames before "
                "are safe in it. Make room and resume."
            ) from error
        self._end += len(data)
        return len(data)


def check_prefix(data: ByteSource, name: str) -> None:
    """Check that ``data`` is a peer's file of this major version.

    Raises:
        StreamError: it is not.
    """
    if bytes(data[: len(MAGIC)]) != MAGIC or len(data) < PREFIX.size:
        raise StreamError(f"{name} is not a file of a peer method: its first bytes are not the format's signature.")
    _, major, minor = PREFIX.unpack(bytes(data[: PREFIX.size]))
    if major != MAJOR:
        raise StreamError(f"{name} has format version {major}.{minor}; this program reads {MAJOR}.x.")
