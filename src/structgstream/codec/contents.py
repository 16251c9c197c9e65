# SPDX-License-Identifier: Apache-2.0
"""What a stream holds: found by reading every record, or by its index."""

import math
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, replace

from structgstream.codec.container.byte_source import ByteSource
from structgstream.codec.container.damage import Damage, PacketSearch, Standing
from structgstream.codec.container.index import Index, indexed_frames
from structgstream.codec.container.payload import parse_packet
from structgstream.codec.container.periods import Period
from structgstream.codec.container.records import Record, RecordType, scan_records
from structgstream.codec.packet_table import KINDS, LOST, Packets
from structgstream.codec.packets import Packet, PacketKind
from structgstream.codec.period_table import PeriodTable
from structgstream.errors import StreamError


@dataclass(frozen=True)
class Contents:
    """What was found besides packets and periods.

    Args:
        runs: the frames that can be decoded, as ranges of consecutive frames.
        damage: the damaged records that whole records follow.
        complete: whether the stream ends with its index, and nothing before it is damaged.
        end: the end of the last whole record before the index.
    """

    runs: tuple[range, ...]
    damage: tuple[Damage, ...]
    complete: bool
    end: int


def first_run(runs: Sequence[range], index: int) -> int:
    """Place of the first of ``runs`` that does not end before frame ``index``."""
    return bisect_right(runs, index, key=lambda run: run.stop)


def contents_by_index(index: Index, packets: Packets, table: PeriodTable, end: int) -> Contents:
    """What an index lists; ``packets`` and ``table`` get their part."""
    packets.offsets = index.offsets
    packets.whole = len(index.offsets)
    table.periods += index.periods
    return Contents((range(len(index.offsets)),), (), True, end)


class Scan:
    """Verifies every record of a stream, and fills ``packets`` and ``table``.

    Args:
        data: the stream.
        name: for messages.
        packets: of the stream, none so far.
        table: its periods, only the first so far.
        gone: frames that are known not to be in ``data`` any more, in order.
    """

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
        """What there is from byte ``end`` on.

        Raises:
            StreamError: whole records contradict each other.
        """
        search, offsets = PacketSearch(self._data), self._packets.offsets
        found: list[tuple[int, int]] = []  # damaged records and the frames expected there
        ended = False
        while not ended:
            for record in scan_records(self._data, end):
                end = record.end
                if ended := record.type == RecordType.INDEX:
                    self._fill_up(indexed_frames(record.payload) if self._broken else len(offsets))
                    break
                self._add(record)
            if ended:
                break
            here = self._broken or Standing(end, len(offsets), self._seconds)
            standing = replace(here, period=self._period)
            following = search.next(end, standing)
            if following is None:
                break
            found.append((end, len(offsets)))
            self._broken = standing
            end = following.offset
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
        elif record.type in KINDS:
            packet = parse_packet(record.payload, KINDS[RecordType(record.type)])
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
            raise StreamError(f"{name} has packet {packet.index} where packet {len(offsets)} belongs.")
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
