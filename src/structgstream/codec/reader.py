# SPDX-License-Identifier: Apache-2.0
"""Reading a stream: header, packets, scenes; complete files and files truncated anywhere.

Note [Nothing is kept]
~~~~~~~~~~~~~~~~~~~~~~
Streams can be long, so a reader keeps only the header, eight bytes per packet and the scene rendered last. Everything
else is read on demand: the facts of a packet from the heads of its record and fields, a scene from its record, whose
checksum is verified then. With the ``raw`` codec packets are independent, so random access costs one packet.
"""

import math
from abc import abstractmethod
from array import array
from bisect import bisect_right
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import overload

import numpy as np
from numpy.typing import NDArray

from structgstream.cameras import Camera
from structgstream.codec.container.blocks import iterate_blocks
from structgstream.codec.container.byte_source import ByteSlice, ByteSource, FileBytes
from structgstream.codec.container.damage import Damage, PacketSearch, next_index
from structgstream.codec.container.index import read_index_offsets
from structgstream.codec.container.init_record import field_sizes
from structgstream.codec.container.packet_head import FRAME
from structgstream.codec.container.payload import parse_packet
from structgstream.codec.container.records import (
    CHECKSUM,
    PREFIX,
    RECORD,
    Record,
    RecordType,
    check_prefix,
    incomplete_reason,
    read_head,
    read_record,
    scan_records,
)
from structgstream.codec.decoder import SceneDecoder
from structgstream.codec.frame_renderer import FrameRenderer
from structgstream.codec.header import unpack_header
from structgstream.codec.packets import Packet, PacketKind
from structgstream.codec.segments.stored_bytes import is_segments, open_segments
from structgstream.errors import StreamError
from structgstream.kernels.backend import Backend, BackendName
from structgstream.scene.scene import Scene

_KINDS = {RecordType.KEY: PacketKind.KEY, RecordType.DELTA: PacketKind.DELTA}


NOTHING = -2  # index of the last decoded frame if there is none: no frame follows it
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
        if head is None or head[0] not in _KINDS or head[1] < FRAME.size:
            raise self.damaged(index)
        start = offset + RECORD.size
        payload = ByteSlice(self._data, start, start + head[1])
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
        size = RECORD.size + head[1] + CHECKSUM.size
        return PacketInfo(_KINDS[RecordType(head[0])], index, pts_seconds, offset, size, field_bytes)

    def damaged(self, index: int) -> StreamError:
        """The error for a packet that was damaged after opening."""
        return StreamError(f"Packet {index} of {self._name}, at byte {self.offsets[index]}, is damaged.")


class StreamReader:
    """A stream in memory or in a file; nearly constant memory (Note [Nothing is kept]).

    Opening verifies every record's checksum, one record at a time. After a damaged record reading continues at the next
    whole packet: :meth:`scene` decodes every frame of :attr:`runs`, while :attr:`packets`, the length and
    :meth:`scenes` end before the first lost frame, so that positions equal frame numbers. With ``by_index`` the offsets
    are taken from the index, if it agrees with the records' heads, and a checksum is verified when its record is read;
    without a valid index the argument has no effect.

    Args:
        data: the bytes, or an open file, which the reader then closes.
        name: of the stream, for messages.
        by_index: open without reading every byte.
        gone: frames that are known not to be in ``data`` any more, in order; they count as lost.

    Attributes:
        header: content of the init record.
        header_bytes: offset of the first packet.
        header_field_bytes: bytes of each field in the init record.
        packets: every whole packet before the first lost one, in order.
        runs: the frames that can be decoded, as ranges of consecutive frames.
        damage: the damaged records that whole records follow, with the frames lost to each.
        complete: whether the stream ends with its index, which is written when a reconstruction finishes.
        cut_reason: why the stream is not complete; None if it is.

    Raises:
        StreamError: not a stream, another major version, no whole init record, or inconsistent records.
    """

    def __init__(
        self,
        data: ByteSource,
        *,
        name: str = "The stream",
        by_index: bool = False,
        gone: Sequence[range] = (),
    ) -> None:
        check_prefix(data, name)
        self._data = data
        self._name = name
        self._gone = {frames.start: frames for frames in gone}
        self.total_bytes = len(data)
        self.complete = False
        self.packets = Packets(data, name)
        self.runs: list[range] = []
        self.damage: list[Damage] = []
        init = read_record(data, PREFIX.size)
        if init is None:
            raise StreamError(f"No frame of {name} can be decoded: {incomplete_reason(data, PREFIX.size)}.")
        if init.type != RecordType.INIT:
            raise StreamError(f"{name} begins with a record of type {init.type}; an init record was expected.")
        self.header = unpack_header(init.payload)
        self.header_bytes = end = init.end
        self.header_field_bytes = field_sizes(init.payload)
        offsets = read_index_offsets(data, end) if by_index and not gone else None
        if offsets is not None:
            self.packets.offsets = offsets
            self.packets.whole = len(offsets)
            self.runs = [range(len(offsets))]
            self.complete = True
        else:
            end = self._scan(end)
        self.cut_reason = None if self.complete else self._reason(end)
        self._decoder = SceneDecoder(self.header)
        self._decoded = NOTHING
        self._renderer = FrameRenderer()

    def _scan(self, end: int) -> int:
        """Verify every record from byte ``end`` on; returns the end of the last whole one."""
        search, seconds = PacketSearch(self._data), -math.inf
        offsets = self.packets.offsets
        found: list[tuple[int, int]] = []  # damaged records and the frames expected there
        ended = False
        while not ended:
            for record in scan_records(self._data, end):
                end = record.end
                if ended := record.type == RecordType.INDEX:
                    break
                seconds = self._add(record, seconds)
            following = None if ended else search.next(end, expected=len(offsets), after_seconds=seconds)
            if following is None:
                break
            found.append((end, len(offsets)))
            offsets.extend([LOST] * (next_index(following) - len(offsets)))
            end = following.offset
        self.complete = ended and not found
        self.damage = [Damage(offset, range(frame, self._shown_from(frame))) for offset, frame in found]
        lost = [*(damage.frames for damage in self.damage), *self._gone.values()]
        self.packets.whole = min([frames.start for frames in lost if frames], default=len(offsets))
        return end

    def _run(self, index: int) -> int:
        """Index of the first of :attr:`runs` that does not end before frame ``index``."""
        return bisect_right(self.runs, index, key=lambda run: run.stop)

    def _shown_from(self, index: int) -> int:
        """The first frame from ``index`` on that can be decoded, or the number of frames."""
        place = self._run(index)
        return max(self.runs[place].start, index) if place < len(self.runs) else len(self.packets.offsets)

    def _reason(self, end: int) -> str:
        """Why the stream, read up to byte ``end``, is not complete."""
        if not self.damage:
            return incomplete_reason(self._data, end)
        reason = f"the record at byte {self.damage[0].offset} of {self.total_bytes} is damaged"
        if len(self.damage) > 1:
            reason += f", and {len(self.damage) - 1} more"
        lost = len(self.packets.offsets) - sum(map(len, self.runs))
        if not lost:
            return f"{reason}; no frame is lost"
        first = len(self.packets)
        shown = self._shown_from(first)
        again = (
            f"frame {shown} can be shown again" if shown < len(self.packets.offsets) else "none after it can be shown"
        )
        return f"{reason}; {lost} of {len(self.packets.offsets)} frames are lost, the first is {first}, {again}"

    def _add(self, record: Record, before_seconds: float) -> float:
        """Record a packet's offset; returns its presentation time, or ``before_seconds`` for another record."""
        if record.type == RecordType.INIT:
            raise StreamError(f"{self._name} has a second init record, at byte {record.offset}.")
        if record.type not in _KINDS:
            return before_seconds
        packet = parse_packet(record.payload, _KINDS[RecordType(record.type)])
        offsets = self.packets.offsets
        if (gone := self._gone.get(len(offsets))) is not None and packet.index == gone.stop:
            offsets.extend([LOST] * len(gone))
        if packet.index != len(offsets):
            raise StreamError(f"{self._name} has packet {packet.index} where packet {len(offsets)} belongs.")
        if packet.index == 0 and packet.kind is not PacketKind.KEY:
            raise StreamError(f"{self._name} begins with a delta packet; the first must be a key packet.")
        if packet.index and packet.pts_seconds <= before_seconds:
            raise StreamError(f"In {self._name} the presentation time of packet {packet.index} does not increase.")
        offsets.append(record.offset)
        if self.runs and self.runs[-1].stop == packet.index:
            self.runs[-1] = range(self.runs[-1].start, packet.index + 1)
        elif packet.kind is PacketKind.KEY or self.header.codec == "raw":
            self.runs.append(range(packet.index, packet.index + 1))
        return packet.pts_seconds

    def __len__(self) -> int:
        return len(self.packets)

    def __enter__(self) -> "StreamReader":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Closes the file, if there is one; later reads raise. Optional: dropping the reader closes it too."""
        if isinstance(self._data, FileBytes):
            self._data.close()

    def scene(self, index: int) -> Scene:
        """The scene of one frame, in normalised units.

        Raises:
            StreamError: there is no such frame, or it has been damaged.
        """
        place = self._run(index)
        if place == len(self.runs) or index not in self.runs[place]:
            raise self._missing(index)
        follows = index == self._decoded + 1
        self._decoded = NOTHING  # Until a packet has been decoded.
        scene: Scene | None = None
        for packet in [self._packet(index)] if follows else self.group(index):
            scene = self._decoder.decode(packet)
        assert scene is not None, "a group ends with its frame"
        self._decoded = index
        return scene

    def render(self, index: int, camera: Camera | str, *, backend: BackendName | Backend = "auto") -> NDArray[np.uint8]:
        """Renders one frame: ``[H, W, 3]`` 8-bit sRGB. The scene is kept for further pictures of the same frame.

        Args:
            index: the frame.
            camera: the name of a camera of the stream's rig (``header.rig``), or any, in the units of the capture.
            backend: the compute back-end.

        Raises:
            StreamError: there is no such frame, or it has been damaged.
            ConfigError: the rig has no camera of that name.
            BackendError: the back-end is not available.
        """
        return self._renderer.picture(index, self.header.camera(camera), decode=self.scene, backend=backend)

    def _missing(self, index: int) -> StreamError:
        if any(index in frames for frames in self._gone.values()):
            return StreamError(f"Frame {index} of {self._name} has left the window of frames that are kept.")
        for damage in self.damage:
            if index in damage.frames:
                return StreamError(
                    f"Frame {index} of {self._name} is lost: the record at byte {damage.offset}, where frame "
                    f"{damage.frames.start} should be, is damaged."
                )
        frames = len(self.packets.offsets)
        have = f"frames 0 to {frames - 1}" if frames else "no whole frame"
        return StreamError(f"{self._name} has {have}; there is no frame {index}.")

    def group(self, index: int) -> Iterator[Packet]:
        """The packets needed to decode frame ``index``, from the key packet to its own; with ``raw`` only its own.

        Raises:
            StreamError: one of them is damaged.
        """
        first = index
        while self.header.codec != "raw" and self.packets.at(first).kind is not PacketKind.KEY:
            first -= 1
        for number in range(first, index + 1):
            yield self._packet(number)

    def _packet(self, index: int) -> Packet:
        record = read_record(self._data, self.packets.offsets[index])
        if record is None or record.type not in _KINDS:
            raise self.packets.damaged(index)
        packet = parse_packet(record.payload, _KINDS[RecordType(record.type)])
        if packet.index != index:
            raise self.packets.damaged(index)
        return packet

    def scenes(self, start: int = 0) -> Iterator[tuple[PacketInfo, Scene]]:
        """Every frame from ``start`` on, one at a time, up to the first lost one."""
        for index in range(*slice(start, None).indices(len(self))):
            scene = self.scene(index)
            yield self.packets[index], scene
            del scene


def open_stream(path: Path | str, *, by_index: bool = False) -> StreamReader:
    """Open a stream file, or a folder of segments. A file is closed at the end of a ``with`` block, by ``close()``, or
    with the reader.

    Args:
        path: the file, the folder, or the folder's manifest.
        by_index: find packets by the file's index instead of verifying every byte first, see :class:`StreamReader`.

    Raises:
        StreamError: there is no such file, or it is not a stream.
    """
    if is_segments(path):
        stored = open_segments(path)
        return StreamReader(stored, name=str(path), by_index=by_index, gone=stored.gone)
    data = FileBytes(path)
    if not len(data):
        raise StreamError(f"{path} is empty; expected a stream made by structgstream reconstruct.")
    return StreamReader(data, name=str(path), by_index=by_index)
