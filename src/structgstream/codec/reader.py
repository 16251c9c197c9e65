# SPDX-License-Identifier: Apache-2.0
"""Reading a stream: header, packets, scenes; whole files and files that were cut anywhere."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from structgstream.codec.decoder import SceneDecoder, packet_of
from structgstream.codec.header import unpacked_header
from structgstream.codec.packets import PacketKind
from structgstream.codec.records import PREFIX, Record, RecordType, check_prefix, record_at, scanned
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
    """A stream in memory.

    ``complete`` says that the index was written, ``cut_reason`` what stopped reading otherwise.

    Raises:
        StreamError: not a stream, another major version, or no whole init record.
    """

    def __init__(self, data: bytes, *, name: str = "The stream") -> None:
        check_prefix(data, name)
        self._data = data
        self._name = name
        self.total_bytes = len(data)
        self.complete = False
        self.packets: list[PacketInfo] = []
        records = scanned(data)
        init = next(records, None)
        if init is None or init.type != RecordType.INIT:
            raise StreamError(f"{name} ends before its init record is whole; nothing of it can be shown.")
        self.header = unpacked_header(init.payload)
        self.header_bytes = init.end
        end = init.end
        for record in records:
            end = record.end
            if record.type == RecordType.INDEX:
                self.complete = True
                break
            self._add(record)
        self.cut_reason = None if self.complete else f"the last whole record ends at byte {end} of {len(data)}"
        self._decoder = SceneDecoder(self.header)

    def _add(self, record: Record) -> None:
        if record.type not in _KINDS:
            return
        packet = packet_of(record.payload, _KINDS[RecordType(record.type)])
        if packet.index != len(self.packets):
            raise StreamError(f"{self._name} jumps from packet {len(self.packets) - 1} to {packet.index}.")
        self.packets.append(
            PacketInfo(
                packet.kind,
                packet.index,
                packet.pts_seconds,
                record.offset,
                record.end - record.offset,
                packet.field_bytes,
            )
        )

    def __len__(self) -> int:
        return len(self.packets)

    def scene(self, index: int) -> Scene:
        """The scene of one frame, in normalised units.

        Raises:
            StreamError: there is no such frame.
        """
        if not 0 <= index < len(self.packets):
            raise StreamError(f"{self._name} has frames 0 to {len(self.packets) - 1}; there is no frame {index}.")
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
    try:
        data = Path(path).read_bytes()
    except OSError as error:
        raise StreamError(f"Cannot read {path} ({error.strerror}).") from error
    if not data:
        raise StreamError(f"{path} is empty.")
    return StreamReader(data, name=str(path))


def readable_part(data: bytes) -> int | None:
    """Where the last whole packet ends, the index and what follows left out; None without a whole init record."""
    if len(data) < PREFIX.size:
        return None
    check_prefix(data, "The file to resume")
    end = None
    for record in scanned(data):
        if record.type == RecordType.INDEX:
            break
        end = record.end
    return end
