# SPDX-License-Identifier: Apache-2.0
"""The packets of a stream by frame: only their offsets are in memory."""

from abc import abstractmethod
from array import array
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import overload

from structgstream.codec.container.blocks import iterate_blocks
from structgstream.codec.container.byte_source import ByteSlice, ByteSource
from structgstream.codec.container.packet_head import FRAME
from structgstream.codec.container.payload import parse_packet
from structgstream.codec.container.records import RECORD, RecordType, read_head, read_record
from structgstream.codec.packets import Packet, PacketKind
from structgstream.errors import StreamError

KINDS = {RecordType.KEY: PacketKind.KEY, RecordType.DELTA: PacketKind.DELTA}
LOST = 2**64 - 1
"""Offset of a packet that is lost."""


@dataclass(frozen=True)
class PacketInfo:
    """Facts of one packet: ``bytes`` is the length of its record, ``field_bytes`` that of each field's part."""

    kind: PacketKind
    index: int
    pts_seconds: float
    offset: int
    bytes: int
    field_bytes: Mapping[str, int]


class PacketInfos(Sequence[PacketInfo]):
    """Facts of packets, each found when it is asked for."""

    @abstractmethod
    def at(self, index: int) -> PacketInfo:
        """Facts of the packet of a frame."""

    @overload
    def __getitem__(self, index: int) -> PacketInfo: ...

    @overload
    def __getitem__(self, index: slice) -> list[PacketInfo]: ...

    def __getitem__(self, index: int | slice) -> PacketInfo | list[PacketInfo]:
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        return self.at(range(len(self))[index])


class Packets(PacketInfos):
    """The packets of a stream in order, up to the first lost one. Only offsets are in memory; indexing reads the heads
    of the packet's record and fields.

    Attributes:
        offsets: of all packets, including those after a lost one; :data:`LOST` for lost ones.
        whole: number of packets before the first lost one.

    Raises:
        StreamError: on indexing a packet that was damaged after the stream was opened.
    """

    def __init__(self, data: ByteSource, name: str) -> None:
        self._data = data
        self._name = name
        self.offsets: array[int] = array("Q")
        self.whole = 0

    def __len__(self) -> int:
        return self.whole

    def at(self, index: int) -> PacketInfo:
        """Facts of the packet of a frame that is not lost."""
        offset = self.offsets[index]
        head = read_head(self._data, offset)
        if head is None or head.type not in KINDS or head.length < FRAME.size:
            raise self.damaged(index)
        start = offset + RECORD.size
        payload = ByteSlice(self._data, start, start + head.length)
        number, pts_seconds = FRAME.unpack(payload[: FRAME.size])
        if number != index:
            raise self.damaged(index)
        try:
            blocks = [*iterate_blocks(payload, FRAME.size, where=f"Packet {index}")]
        except StreamError as error:
            if read_record(self._data, offset) is None:  # The record was damaged after opening.
                raise self.damaged(index) from error
            raise
        field_bytes: dict[str, int] = {block.name: block.end - block.start for block in blocks}
        return PacketInfo(KINDS[RecordType(head.type)], index, pts_seconds, offset, head.bytes, field_bytes)

    def packet(self, index: int) -> Packet:
        """The packet of a frame that is not lost; its checksum is verified."""
        record = read_record(self._data, self.offsets[index])
        if record is None or record.type not in KINDS:
            raise self.damaged(index)
        packet = parse_packet(record.payload, KINDS[RecordType(record.type)])
        if packet.index != index:
            raise self.damaged(index)
        return packet

    def damaged(self, index: int) -> StreamError:
        """The error for a packet that was damaged after opening."""
        return StreamError(f"Packet {index} of {self._name}, at byte {self.offsets[index]}, is damaged.")
