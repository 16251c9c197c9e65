# SPDX-License-Identifier: Apache-2.0
"""Continues a stream of segments: a sink, and the existing frames."""

from collections.abc import Iterator, Sequence

from structgstream.codec.container.periods import Period, period_at
from structgstream.codec.packet_table import LOST, PacketInfo, PacketInfos
from structgstream.codec.packets import Packet, StreamHeader
from structgstream.codec.reader import StreamReader
from structgstream.codec.segments.recovery import find
from structgstream.codec.segments.retention import SegmentsOptions
from structgstream.codec.segments.sink import Clocks, SegmentsSink
from structgstream.codec.segments.store import Store
from structgstream.codec.segments.stored_bytes import StoredBytes
from structgstream.scene.scene import Scene


class StoredPackets(PacketInfos):
    """Facts of all packets; of those that have left the window only size and kind are known."""

    def __init__(self, stored: StoredBytes, reader: StreamReader) -> None:
        self._stored = stored
        self._reader = reader

    def __len__(self) -> int:
        return len(self._stored.sizes)

    def at(self, index: int) -> PacketInfo:
        """Facts of the packet of a frame."""
        if self._reader.packets.offsets[index] != LOST:
            return self._reader.packets.at(index)
        return PacketInfo(self._stored.kinds[index], index, float("nan"), LOST, self._stored.sizes[index], {})


class StoredSegments:
    """The existing frames of a stream of segments, some of which may have left the window.

    Attributes:
        packets: facts of all frames from 0 on.
        complete: whether the run had ended.
    """

    def __init__(self, stored: StoredBytes, *, name: str) -> None:
        self._reader = StreamReader(stored, name=name, gone=stored.gone)
        self._periods = stored.periods
        self.packets: Sequence[PacketInfo] = StoredPackets(stored, self._reader)
        self.complete = self._reader.complete

    @property
    def header(self) -> StreamHeader:
        """Content of the init record."""
        return self._reader.header

    def __len__(self) -> int:
        return len(self.packets)

    def header_of(self, index: int) -> StreamHeader:
        """The header of the period of a frame, see :meth:`StreamReader.header_of`."""
        return self._reader.header_of(index)

    def period(self, index: int) -> Period:
        """The period of a frame, also of one that has left the window."""
        return self._periods[period_at(self._periods, index)]

    def group(self, index: int) -> Iterator[Packet]:
        """The packets needed to decode frame ``index``, see :meth:`StreamReader.group`."""
        return self._reader.group(index)

    def scene(self, index: int) -> Scene:
        """The scene of one frame, see :meth:`StreamReader.scene`."""
        return self._reader.scene(index)


def resume_segments(
    store: Store, *, options: SegmentsOptions | None = None, clocks: Clocks | None = None
) -> tuple[SegmentsSink, StoredSegments | None]:
    """A sink that continues a stream of segments after its last written frame, and its existing frames.

    They are None if there is no whole frame: the stream then begins again. Nothing is changed before the sink is
    opened.

    Raises:
        StreamError: the stream is damaged so that it cannot be continued.
    """
    found = find(store)
    sink = SegmentsSink(store, overwrite=True, options=options, clocks=clocks, found=found)
    if found is None:
        return sink, None
    held = dict(found.files)
    held |= {part.file: record for part, record in zip(found.manifest.parts, found.records, strict=True)}
    return sink, StoredSegments(StoredBytes(store, found.manifest, held=held, check=True), name=store.name)
