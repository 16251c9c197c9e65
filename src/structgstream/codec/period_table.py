# SPDX-License-Identifier: Apache-2.0
"""The periods of a stream: where they begin, and the header of each, read when it is asked for."""

from collections.abc import Sequence

from structgstream.codec.container.byte_source import ByteSource
from structgstream.codec.container.init_record import field_sizes
from structgstream.codec.container.periods import Period, period_at
from structgstream.codec.container.records import Record, RecordType, read_record
from structgstream.codec.header import unpack_header
from structgstream.codec.packets import StreamHeader
from structgstream.errors import StreamError
from structgstream.similarity import Similarity


class PeriodTable:
    """The periods of one stream, the first of which is always there. One header besides the first is in memory.

    Args:
        data: the stream.
        name: of the stream, for messages.
        init: its first init record.

    Attributes:
        first: the header of the first period.
        periods: those of which a packet has been found, in order; always the first.

    Raises:
        StreamError: the init record is not valid.
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
        """The header of the period at ``place``.

        Raises:
            StreamError: its init record has been damaged, or does not belong to this stream.
        """
        period = self.periods[place]
        if place == 0:
            return self.first
        if self._last[0] != period:
            self._last = period, self.check(self._record(period))
        return self._last[1]

    def check(self, init: Record) -> StreamHeader:
        """The header of a later init record.

        Raises:
            StreamError: it is not valid, or is of another stream.
        """
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
        "cameras": _cameras(first) != _cameras(later),
        "similarity": _plain(first.similarity) != _plain(later.similarity),
        "frames a second": first.fps != later.fps,
        "codec": first.codec != later.codec,
    }
    return [name for name, differs in found.items() if differs]


def _plain(similarity: Similarity) -> tuple[float, ...]:
    return (*similarity.center, similarity.scale)


def _cameras(header: StreamHeader) -> list[tuple[object, ...]]:
    rig = header.rig
    return [
        (
            name,
            rig[name].viewmat.tolist(),
            rig[name].K.tolist(),
            rig[name].width,
            rig[name].height,
            rig[name].near,
            name in rig.held_out,
        )
        for name in rig
    ]
