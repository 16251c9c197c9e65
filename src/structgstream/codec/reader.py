# SPDX-License-Identifier: Apache-2.0
"""Reading a stream: header, packets, scenes; complete files and files truncated anywhere.

Note [Nothing is cached]
~~~~~~~~~~~~~~~~~~~~~~~~
Streams can be long, so a reader keeps only two headers, eight bytes per packet and the scene rendered last. Everything
else is read on demand: the facts of a packet from the heads of its record and fields, a scene from its record, whose
checksum is verified then. With the ``raw`` codec packets are independent, so random access costs one packet.
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from structgstream.cameras import Camera
from structgstream.codec.container.byte_source import ByteSource, FileBytes
from structgstream.codec.container.records import (
    PREFIX,
    Period,
    RecordType,
    check_prefix,
    incomplete_reason,
    read_index,
    read_record,
)
from structgstream.codec.contents import Contents, Damage, PacketInfo, Packets, PeriodTable, Scan, first_run
from structgstream.codec.packets import Packet, PacketKind, StreamHeader
from structgstream.codec.scene_coder import SceneDecoder
from structgstream.codec.segments.stored_bytes import is_segments, open_segments
from structgstream.codec.sound import FrameSound
from structgstream.errors import StreamError
from structgstream.kernels.backend import Backend, BackendName, select_backend
from structgstream.scene.render import render_picture
from structgstream.scene.scene import Scene
from structgstream.scene.state import on_device

NOTHING = -2  # index of the last decoded frame if there is none: no frame follows it


class StreamReader:
    """A stream in memory or in a file; nearly constant memory (Note [Nothing is cached]).

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
        header: content of the first init record. What all periods share (cameras, similarity, frame rate, codec) holds
            for the stream; :meth:`header_of` has the rest.
        periods: where periods begin; at least one.
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
        self._gone = tuple(gone)
        self.total_bytes = len(data)
        self.packets = Packets(data, name)
        init = read_record(data, PREFIX.size)
        if init is None:
            raise StreamError(f"No frame of {name} can be decoded: {incomplete_reason(data, PREFIX.size)}.")
        if init.type != RecordType.INIT:
            raise StreamError(f"{name} begins with a record of type {init.type}; an init record was expected.")
        self._table = PeriodTable(data, name, init)
        index = read_index(data, init.end, period=init.period) if by_index and not gone else None
        if index is not None:
            self.packets.offsets, later = index
            self.packets.whole = len(self.packets.offsets)
            self._table.periods += later
            contents = Contents((range(len(self.packets.offsets)),), (), True, init.end)
        else:
            contents = Scan(data, name, self.packets, self._table, gone=gone).contents(init.end)
        self.runs: list[range] = [*contents.runs]
        self.damage: list[Damage] = [*contents.damage]
        self.complete = contents.complete
        self.cut_reason = None if self.complete else self._reason(contents.end)
        self._decoder: tuple[int, SceneDecoder] = 0, SceneDecoder(self.header)
        self._decoded = NOTHING
        self._chosen: tuple[BackendName | Backend, Backend] | None = None  # as asked for, and what was selected
        self._drawn: tuple[int, Scene] | None = None  # the scene rendered last

    @property
    def header(self) -> StreamHeader:
        """Content of the first init record."""
        return self._table.first

    @property
    def periods(self) -> Sequence[Period]:
        """Where periods begin."""
        return tuple(self._table.periods)

    def header_of(self, index: int) -> StreamHeader:
        """The header of the period that frame ``index`` belongs to.

        Raises:
            StreamError: its init record has been damaged.
        """
        return self._table.header(self._table.place(index))

    def period(self, index: int) -> Period:
        """The period that frame ``index`` belongs to."""
        return self._table.periods[self._table.place(index)]

    @property
    def header_bytes(self) -> int:
        """Bytes of prefix and init records."""
        return PREFIX.size + sum(period.bytes for period in self._table.periods)

    @property
    def header_field_bytes(self) -> dict[str, int]:
        """Bytes of each field in all init records together."""
        sums = Counter[str]()
        for place in range(len(self._table.periods)):
            sums.update(self._table.field_bytes(place))
        return dict(sums)

    def field_bytes_of(self, place: int) -> dict[str, int]:
        """Bytes of each field in the init record of the period at ``place`` in :attr:`periods`."""
        return self._table.field_bytes(place)

    def _reason(self, end: int) -> str:
        """Why the stream, read up to byte ``end``, is not complete."""
        if not self.damage:
            return incomplete_reason(self._data, end)
        reason = f"the record at byte {self.damage[0].offset} of {self.total_bytes} is damaged"
        if len(self.damage) > 1:
            reason += f", and {len(self.damage) - 1} more"
        frames = len(self.packets.offsets)
        lost = frames - sum(map(len, self.runs))
        if not lost:
            return f"{reason}; no frame is lost"
        first = len(self.packets)
        place = first_run(self.runs, first)
        again = "none after it can be shown"
        if place < len(self.runs):
            again = f"frame {max(self.runs[place].start, first)} can be shown again"
        return f"{reason}; {lost} of {frames} frames are lost, the first is {first}, {again}"

    def __len__(self) -> int:
        return len(self.packets)

    def __enter__(self) -> "StreamReader":
        return self

    def __exit__(self, *raised: object) -> None:
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
        if not self._is_whole(index):
            raise self._missing(index)
        follows = index == self._decoded + 1
        self._decoded = NOTHING  # Until a packet has been decoded.
        period = self._table.place(index)
        if self._decoder[0] != period:
            self._decoder = period, SceneDecoder(self._table.header(period))
        scene: Scene | None = None
        for packet in [self.packets.packet(index)] if follows else self.group(index):
            scene = self._decoder[1].decode(packet)
        assert scene is not None, "a group ends with its frame"
        self._decoded = index
        return scene

    def render(self, index: int, camera: Camera | str, *, backend: BackendName | Backend = "auto") -> NDArray[np.uint8]:
        """Renders one frame: ``[H, W, 3]`` 8-bit sRGB. The scene is stored for further pictures of the same frame.

        Args:
            index: the frame.
            camera: the name of a camera of the stream's rig (``header.rig``), or any, in the units of the capture.
            backend: the compute back-end.

        Raises:
            StreamError: there is no such frame, or it has been damaged.
            ConfigError: the rig has no camera of that name.
            BackendError: the back-end is not available.
        """
        view = self.header.camera(camera)
        if self._chosen is None or self._chosen[0] != backend:
            self._chosen, self._drawn = (backend, select_backend(backend)), None
        _, chosen = self._chosen
        if self._drawn is None or self._drawn[0] != index:
            self._drawn = None  # So that two scenes are not in memory at once.
            self._drawn = index, on_device(self.scene(index), chosen.device)
        return render_picture(self._drawn[1], view, chosen)

    def _is_whole(self, index: int) -> bool:
        place = first_run(self.runs, index)
        return place < len(self.runs) and index in self.runs[place]

    def _missing(self, index: int) -> StreamError:
        if any(index in frames for frames in self._gone):
            return StreamError(f"Frame {index} of {self._name} has left the window of the stream.")
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
            yield self.packets.packet(number)

    def sound(self, index: int) -> FrameSound | None:
        """The sound that is stored with one frame; None if there is none, if it or the frame is damaged, or, with a
        warning in the log, if its record does not follow the format."""
        return self.packets.sound(index) if self._is_whole(index) else None

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
