# SPDX-License-Identifier: Apache-2.0
"""What a stream holds: packets and periods, found by reading every record, or by its index; and after damage, where
whole records go on (docs/bitstream.md, section Damage)."""

import logging
import math
import re
from array import array
from bisect import bisect_right
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import overload

from structgstream.codec.container.blocks import LENGTH, field_sizes, iterate_blocks
from structgstream.codec.container.byte_source import ByteSlice, ByteSource
from structgstream.codec.container.records import (
    CHECKSUM,
    FRAME,
    INDEX_ENTRY,
    PACKET_KINDS,
    RECORD,
    Head,
    Period,
    Record,
    RecordType,
    indexed_frames,
    period_at,
    read_frame,
    read_head,
    read_record,
    scan_records,
)
from structgstream.codec.packets import Packet, PacketKind, StreamHeader, parse_packet, unpack_header
from structgstream.codec.sound import FrameSound, unpack_sound
from structgstream.errors import StreamError

log = logging.getLogger(__name__)

_KNOWN_TYPES = frozenset(RecordType)
MIN_PACKET_BYTES = RECORD.size + FRAME.size + CHECKSUM.size
_ZSTD = bytes.fromhex("28b52ffd")  # which an init record's description begins with
_CHUNK_BYTES = 2**20
_WORK = 4


@dataclass(frozen=True)
class Damage:
    """A damaged record that whole records follow."""

    offset: int  # its first byte
    frames: range  # the frames lost to it: its own, and those up to the next key packet


@dataclass(frozen=True)
class Standing:
    """What is known of a stream where a record is not whole."""

    # where that record begins; of several in a row without a whole packet between them, where the first does
    offset: int
    frames: int  # number of the next frame
    seconds: float  # presentation time of the last frame
    period: int = 0  # number of the last whole init record

    def last_frame_at(self, offset: int) -> int:
        """The last frame that a packet at ``offset`` may be: frames before it take bytes, too."""
        return self.frames + (offset - self.offset) // MIN_PACKET_BYTES

    def allows(self, index: Record) -> bool:
        """Whether an index record lists as many frames as there may be."""
        return self.frames <= indexed_frames(index.payload) <= self.last_frame_at(index.offset)


class PacketSearch:
    """Finds whole records after damage in ``data``.

    Use one object per stream: all its calls together verify checksums of at most four times the stream's bytes, which
    bounds the work that a malicious file can cause.
    """

    def __init__(self, data: ByteSource) -> None:
        self._data = data
        self._left = _WORK * len(data)

    def next(self, damaged: int, standing: Standing) -> Record | None:
        """The first whole packet, init record or index after byte ``damaged``, where a record is not whole."""
        for offset, head in self._heads(damaged + 1, standing.period):
            if not self._may_follow(head, offset, standing):
                continue
            self._left -= head.length
            if self._left < 0:
                return None
            record = read_record(self._data, offset)
            if record is not None and (record.type != RecordType.INDEX or standing.allows(record)):
                return record
        return None

    def _heads(self, start: int, period: int) -> Iterator[tuple[int, Head]]:
        """What may be heads of such records from ``start`` on, and where; all of each record is there."""
        number = re.escape(period.to_bytes(2, "little"))
        pattern = re.compile(rb"\x01|[\x02\x03].%b|\x04.\x00\x00" % number, re.DOTALL)
        while start + RECORD.size <= len(self._data):
            chunk = bytes(self._data[start : start + _CHUNK_BYTES])
            at = 0
            while (match := pattern.search(chunk, at)) is not None and match.start() + RECORD.size <= len(chunk):
                offset, at = start + match.start(), match.start() + 1
                kind, _, of, length = RECORD.unpack_from(chunk, match.start())
                head = Head(kind, of, length)
                if offset + head.bytes <= len(self._data):
                    yield offset, head
            start += max(len(chunk) - RECORD.size + 1, 1)

    def _may_follow(self, head: Head, offset: int, standing: Standing) -> bool:
        """Whether a record at ``offset`` is, by its head, consistent with what is known before the damage."""
        last = standing.last_frame_at(offset)
        if head.type == RecordType.INIT:
            start = offset + RECORD.size + LENGTH.size
            return head.period > standing.period and bytes(self._data[start : start + len(_ZSTD)]) == _ZSTD
        if head.type == RecordType.INDEX:
            entries = head.length // INDEX_ENTRY.size
            return head.length % INDEX_ENTRY.size == 0 and standing.frames <= entries <= 2 * last
        if head.length < FRAME.size:
            return False
        index, pts_seconds = read_frame(self._data, offset)
        return standing.frames <= index <= last and standing.seconds < pts_seconds < math.inf


LOST = 2**64 - 1
"""Offset of a packet that is lost."""


@dataclass(frozen=True)
class PacketInfo:
    """Facts of one packet: ``bytes`` is the length of its record and of its sound's, ``field_bytes`` that of each
    field's part, and of the record of the sound as ``sound``."""

    kind: PacketKind
    index: int
    pts_seconds: float
    offset: int
    bytes: int
    field_bytes: Mapping[str, int]


class Packets(Sequence[PacketInfo]):
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

    @overload
    def __getitem__(self, index: int) -> PacketInfo: ...

    @overload
    def __getitem__(self, index: slice) -> list[PacketInfo]: ...

    def __getitem__(self, index: int | slice) -> PacketInfo | list[PacketInfo]:
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        return self.at(range(len(self))[index])

    def at(self, index: int) -> PacketInfo:
        """Facts of the packet of a frame that is not lost."""
        offset = self.offsets[index]
        head = read_head(self._data, offset)
        if head is None or head.type not in PACKET_KINDS or head.length < FRAME.size:
            raise self.damaged(index)
        number, pts_seconds = read_frame(self._data, offset)
        if number != index:
            raise self.damaged(index)
        payload = ByteSlice(self._data, start := offset + RECORD.size, start + head.length)
        try:
            blocks = [*iterate_blocks(payload, FRAME.size, where=f"Packet {index}")]
        except StreamError as error:
            if read_record(self._data, offset) is None:  # The record was damaged after opening.
                raise self.damaged(index) from error
            raise
        field_bytes: dict[str, int] = {block.name: block.end - block.start for block in blocks}
        size = head.bytes
        if (sound := self._sound_head(offset + head.bytes)) is not None:
            at, sound_head = sound
            size = at + sound_head.bytes - offset
            field_bytes["sound"] = sound_head.bytes
        return PacketInfo(PACKET_KINDS[head.type], index, pts_seconds, offset, size, field_bytes)

    def packet(self, index: int) -> Packet:
        """The packet of a frame that is not lost; its checksum is verified."""
        record = read_record(self._data, self.offsets[index])
        if record is None or record.type not in PACKET_KINDS:
            raise self.damaged(index)
        packet = parse_packet(record.payload, PACKET_KINDS[record.type])
        if packet.index != index:
            raise self.damaged(index)
        return packet

    def sound(self, index: int) -> FrameSound | None:
        """The sound that is stored with a frame that is not lost; None if there is none, it is damaged, or, with a
        warning, it does not follow the format."""
        head = read_head(self._data, self.offsets[index])
        found = None if head is None else self._sound_head(self.offsets[index] + head.bytes)
        record = None if found is None else read_record(self._data, found[0])
        if record is None:
            return None
        try:
            sound = unpack_sound(record.payload)
        except StreamError as error:
            log.warning("%s The frame is silent.", error)
            return None
        return sound if sound.index == index else None

    def _sound_head(self, end: int) -> tuple[int, Head] | None:
        """Offset and head of the sound record of the packet that ends at byte ``end``, behind records of unknown types
        such as layers."""
        head = read_head(self._data, end)
        while head is not None and head.type not in _KNOWN_TYPES:
            end += head.bytes
            head = read_head(self._data, end)
        return None if head is None or head.type != RecordType.SOUND else (end, head)

    def damaged(self, index: int) -> StreamError:
        """The error for a packet that was damaged after opening."""
        return StreamError(f"Packet {index} of {self._name}, at byte {self.offsets[index]}, is damaged.")


class PeriodTable:
    """The periods of one stream, the first of which is always there. One header besides the first is in memory. Raises
    StreamError if the first init record is not valid.

    Attributes:
        first: the header of the first period.
        periods: those of which a packet has been found, in order; always the first.
    """

    def __init__(self, data: ByteSource, name: str, init: Record) -> None:
        self._data = data
        self._name = name
        self.first = unpack_header(init.payload)
        self.periods: list[Period] = [Period(init.period, 0, init.offset, init.end - init.offset)]
        self._last: tuple[Period, StreamHeader] = self.periods[0], self.first

    def place(self, frame: int) -> int:
        """The place in :attr:`periods` of the period of a frame."""
        return period_at(self.periods, frame)

    def header(self, place: int) -> StreamHeader:
        """The header of the period at ``place``. Raises StreamError if its init record has been damaged, or does not
        belong to this stream."""
        period = self.periods[place]
        if place == 0:
            return self.first
        if self._last[0] != period:
            self._last = period, self.check(self._record(period))
        return self._last[1]

    def check(self, init: Record) -> StreamHeader:
        """The header of a later init record. Raises StreamError if it is not valid, or is of another stream."""
        header = unpack_header(init.payload)
        if differing := list(differences(self.first, header)):
            raise StreamError(
                f"The init record of period {init.period} of {self._name}, at byte {init.offset}, has other "
                f"{differing[0]} than the first; a stream keeps them. Write it as a stream of its own."
            )
        return header

    def field_bytes(self, place: int) -> dict[str, int]:
        """Bytes of each field in the init record of the period at ``place``."""
        return field_sizes(self._record(self.periods[place]).payload)

    def _record(self, period: Period) -> Record:
        record = read_record(self._data, period.offset)
        if record is None or record.type != RecordType.INIT or record.period != period.number:
            raise StreamError(
                f"The init record of period {period.number} of {self._name}, at byte {period.offset}, is damaged."
            )
        return record


def differences(first: StreamHeader, later: StreamHeader) -> Sequence[str]:
    """What may not change from period to period and differs."""
    found = {
        "cameras": [*first.rig.plain().items()] != [*later.rig.plain().items()],
        "similarity": first.similarity != later.similarity,
        "frames a second": first.fps != later.fps,
        "codec": first.codec != later.codec,
        "sound": (first.sound, first.unknown_sound) != (later.sound, later.unknown_sound),
    }
    return [name for name, differs in found.items() if differs]


@dataclass(frozen=True)
class Contents:
    """What was found besides packets and periods."""

    runs: tuple[range, ...]  # the frames that can be decoded, as ranges of consecutive frames
    damage: tuple[Damage, ...]  # the damaged records that whole records follow
    complete: bool  # whether the stream ends with its index, and nothing before it is damaged
    end: int  # the end of the last whole record before the index


def first_run(runs: Sequence[range], index: int) -> int:
    """Place of the first of ``runs`` that does not end before frame ``index``."""
    return bisect_right(runs, index, key=lambda run: run.stop)


class Scan:
    """Verifies every record of a stream, and fills ``packets``, and ``table``, which has the first period only. Frames
    of ``gone``, in order, are known not to be in ``data`` any more."""

    def __init__(
        self, data: ByteSource, name: str, packets: Packets, table: PeriodTable, *, gone: Sequence[range]
    ) -> None:
        self._data = data
        self._name = name
        self._packets = packets
        self._table = table
        self._gone = {frames.start: frames for frames in gone}
        self._runs: list[range] = []
        self._seconds = -math.inf
        self._period = table.periods[0].number
        self._pending: Period | None = None  # its first packet has not come
        self._broken: Standing | None = None  # since the last whole packet a record was not whole

    def contents(self, end: int) -> Contents:
        """What there is from byte ``end`` on. Raises StreamError if whole records contradict each other."""
        search, offsets = PacketSearch(self._data), self._packets.offsets
        found: list[tuple[int, int]] = []  # damaged records and the frames expected there
        ended = False
        while not ended:
            record = next(scan_records(self._data, end), None)
            if record is None:
                standing = replace(self._broken or Standing(end, len(offsets), self._seconds), period=self._period)
                if (following := search.next(end, standing)) is None:
                    break
                found.append((end, len(offsets)))
                self._broken, end = standing, following.offset
                continue
            end = record.end
            if record.type == RecordType.INDEX:
                ended = True
                if self._broken is not None:
                    self._fill_up(indexed_frames(record.payload))
            else:
                self._add(record)
        damage = tuple(Damage(offset, range(frame, self._shown_from(frame))) for offset, frame in found)
        lost = [*(one.frames for one in damage), *self._gone.values()]
        self._packets.whole = min([frames.start for frames in lost if frames], default=len(offsets))
        return Contents(tuple(self._runs), damage, ended and not found, end)

    def _shown_from(self, index: int) -> int:
        """The first frame from ``index`` on that can be decoded, or the number of frames."""
        place = first_run(self._runs, index)
        return max(self._runs[place].start, index) if place < len(self._runs) else len(self._packets.offsets)

    def _fill_up(self, count: int) -> None:
        """All frames up to before number ``count`` are lost."""
        offsets = self._packets.offsets
        offsets.extend([LOST] * (count - len(offsets)))

    def _add(self, record: Record) -> None:
        if record.type == RecordType.INIT:
            self._add_init(record)
        elif record.type in PACKET_KINDS:
            packet = parse_packet(record.payload, PACKET_KINDS[record.type])
            self._check(packet, record)
            self._add_packet(packet, record)

    def _add_init(self, record: Record) -> None:
        """What a period begins with; it counts from its first packet on."""
        follows = record.period == self._period + 1
        empty = self._pending is not None or not self._packets.offsets
        if self._broken is None and (empty or not follows):
            expected = "a packet" if follows else f"one of period {self._period + 1}, or a packet,"
            raise StreamError(
                f"{self._name} has an init record of period {record.period}, at byte {record.offset}, where {expected} "
                "belongs."
            )
        self._table.check(record)
        self._period = record.period
        self._pending = Period(record.period, 0, record.offset, record.end - record.offset)

    def _check(self, packet: Packet, record: Record) -> None:
        """Check that a packet can come next."""
        offsets, name = self._packets.offsets, self._name
        if (gone := self._gone.get(len(offsets))) is not None and packet.index == gone.stop:
            self._fill_up(gone.stop)
        if (broken := self._broken) is not None and broken.frames <= packet.index <= broken.last_frame_at(
            record.offset
        ):
            self._fill_up(packet.index)
        if record.period != self._period:
            raise StreamError(
                f"{name} has a packet of period {record.period}, at byte {record.offset}, after the init record of "
                f"period {self._period}."
            )
        if packet.index != len(offsets):
            advice = "" if offsets else " If structgstream fit-group wrote it, join it with the groups before it."
            raise StreamError(f"{name} has packet {packet.index} where packet {len(offsets)} belongs.{advice}")
        begins = packet.index == 0 or (self._pending is not None and broken is None)
        if begins and packet.kind is not PacketKind.KEY:
            what = f"Period {self._period} of {name}" if packet.index else name
            raise StreamError(f"{what} begins with a delta packet; the first must be a key packet.")
        if packet.index and packet.pts_seconds <= self._seconds:
            raise StreamError(f"In {name} the presentation time of packet {packet.index} does not increase.")

    def _add_packet(self, packet: Packet, record: Record) -> None:
        runs, begins = self._runs, self._pending is not None
        alone = packet.kind is PacketKind.KEY or self._table.first.codec == "raw"
        if self._pending is not None:
            self._table.periods.append(replace(self._pending, first_frame=packet.index))
            self._pending = None
        elif not runs and self._period:  # Earlier periods are gone.
            self._table.periods[0] = replace(self._table.periods[0], first_frame=packet.index)
        if runs and runs[-1].stop == packet.index and (alone or not begins):
            runs[-1] = range(runs[-1].start, packet.index + 1)
        elif alone:
            runs.append(range(packet.index, packet.index + 1))
        self._broken = None
        self._seconds = packet.pts_seconds
        self._packets.offsets.append(record.offset)
