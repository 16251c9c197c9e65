# SPDX-License-Identifier: Apache-2.0
"""Reading a stream: header, packets, scenes; whole files and files that were cut anywhere."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from structgstream.codec.decoder import SceneDecoder, packet_of
from structgstream.codec.header import unpacked_header
from structgstream.codec.packets import PacketKind
from structgstream.codec.records import (
    CHECKSUM,
    PREFIX,
    RECORD,
    Record,
    RecordType,
    check_prefix,
    prefix,
    record_at,
    scanned,
    why_stopped,
)
from structgstream.errors import StreamError
from structgstream.scene.scene import Scene
from structgstream.scene.state import FieldName

_KINDS = {RecordType.KEY: PacketKind.KEY, RecordType.DELTA: PacketKind.DELTA}


@dataclass(frozen=True)
class PacketInfo:
    """One packet's place in a stream: ``bytes`` counts the whole record, ``field_bytes`` the fields' parts."""

    kind: PacketKind
    index: int
    pts_seconds: float
    offset: int
    bytes: int
    field_bytes: Mapping[FieldName, int]


class StreamReader:
    """A stream in memory. Every record's checksum is verified once, on opening; what comes after damage is not read.

    Attributes:
        header: what the init record says.
        packets: every whole packet before the first cut or damage, in order.
        complete: whether the index was written, so that the run that made the stream had come to its end.
        cut_reason: what stopped reading otherwise.

    Raises:
        StreamError: not a stream, another major version, no whole init record, or records that contradict each other.
    """

    def __init__(self, data: bytes | memoryview, *, name: str = "The stream") -> None:
        check_prefix(data, name)
        self._data = data
        self._name = name
        self.total_bytes = len(data)
        self.complete = False
        self.packets: list[PacketInfo] = []
        records = scanned(data)
        init = next(records, None)
        if init is None:
            raise StreamError(f"Nothing of {name} can be shown: {why_stopped(data, PREFIX.size)}.")
        if init.type != RecordType.INIT:
            raise StreamError(f"{name} begins with a record of type {init.type}; an init record was expected.")
        self.header = unpacked_header(init.payload)
        self.header_bytes = end = init.end
        for record in records:
            end = record.end
            if record.type == RecordType.INDEX:
                self.complete = True
                break
            self._add(record)
        self.cut_reason = None if self.complete else why_stopped(data, end)
        self._decoder = SceneDecoder(self.header)

    def _add(self, record: Record) -> None:
        if record.type == RecordType.INIT:
            raise StreamError(f"{self._name} has a second init record, at byte {record.offset}.")
        if record.type not in _KINDS:
            return
        packet = packet_of(record.payload, _KINDS[RecordType(record.type)])
        if packet.index != len(self.packets):
            raise StreamError(f"{self._name} has packet {packet.index} where packet {len(self.packets)} belongs.")
        if packet.index == 0 and packet.kind is not PacketKind.KEY:
            raise StreamError(f"{self._name} begins with a delta packet; the first must be a key packet.")
        if packet.index and packet.pts_seconds <= self.packets[-1].pts_seconds:
            raise StreamError(f"In {self._name} packet {packet.index} is not presented after the one before it.")
        size = record.end - record.offset
        self.packets.append(
            PacketInfo(packet.kind, packet.index, packet.pts_seconds, record.offset, size, packet.field_bytes)
        )

    def __len__(self) -> int:
        return len(self.packets)

    def scene(self, index: int) -> Scene:
        """The scene of one frame, in normalised units.

        Raises:
            StreamError: there is no such frame.
        """
        if not 0 <= index < len(self):
            have = f"frames 0 to {len(self) - 1}" if self.packets else "no whole frame"
            raise StreamError(f"{self._name} has {have}; there is no frame {index}.")
        info = self.packets[index]
        record = record_at(self._data, info.offset)
        if record is None:
            raise StreamError(f"Packet {index} of {self._name}, at byte {info.offset}, is damaged.")
        return self._decoder.decode(packet_of(record.payload, info.kind))

    def scenes(self, start: int = 0) -> Iterator[tuple[PacketInfo, Scene]]:
        """Every frame from ``start`` on."""
        for info in self.packets[start:]:
            yield info, self.scene(info.index)


def open_stream(path: Path | str) -> StreamReader:
    """Read a stream file.

    Raises:
        StreamError: there is no such file, or it is not a stream.
    """
    data = stored_bytes(path)
    if not data:
        raise StreamError(f"{path} is empty; expected a stream made by structgstream reconstruct.")
    return StreamReader(data, name=str(path))


def stored_bytes(path: Path | str) -> bytes:
    """The bytes of a file.

    Raises:
        StreamError: it cannot be read.
    """
    try:
        return Path(path).read_bytes()
    except OSError as error:
        raise StreamError(f"Cannot read {path} ({error.strerror}); expected a stream file.") from error


def record_after_damage(data: bytes, offset: int) -> bool:
    """Whether a whole record follows a damaged one at ``offset``: no crash leaves that, only a medium that forgets."""
    if offset + RECORD.size > len(data) or record_at(data, offset) is not None:
        return False
    length = RECORD.unpack_from(data, offset)[3]
    return record_at(data, offset + RECORD.size + length + CHECKSUM.size) is not None


def readable_part(data: bytes, *, name: str) -> int | None:
    """Where the last whole packet ends, the index and what follows left out; None when the init record was cut.

    Raises:
        StreamError: not a stream, another major version, or an init record that is there and damaged: starting again
            would throw away what follows it.
    """
    if prefix().startswith(data):
        return None  # Cut within the prefix, or empty.
    check_prefix(data, name)
    end = PREFIX.size
    for record in scanned(data):
        if record.type == RecordType.INDEX:
            break
        end = record.end
    if end > PREFIX.size:
        if record_after_damage(data, end):
            raise StreamError(
                f"Cannot continue {name}: {why_stopped(data, end)}, and whole frames follow it that continuing would "
                f"throw away. Keep a copy, then cut the file to {end} bytes and use --resume to fit them anew."
            )
        return end
    reason = why_stopped(data, end)
    if "damaged" in reason:
        raise StreamError(f"Cannot continue {name}: {reason}. Start again with --overwrite.")
    return None
