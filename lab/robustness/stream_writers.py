# SPDX-License-Identifier: Apache-2.0
"""Writers of streams for ``kills``, and what a reader finds of what they wrote."""

import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

from structgstream.codec.container.records import FRAME, footer_offset
from structgstream.codec.packets import Packet, PacketSink, StreamHeader
from structgstream.codec.reader import StreamReader, open_stream
from structgstream.codec.segments.recovery import find
from structgstream.codec.segments.sink import SegmentsOptions
from structgstream.codec.segments.store import FolderStore
from structgstream.codec.segments.stored_bytes import StoredBytes, read_manifest, write_archive
from structgstream.codec.sinks import FileSink, MemorySink, resume_segments
from structgstream.errors import StreamError

PACE_SECONDS = 0.004
OPTIONS = SegmentsOptions(grace_seconds=0.2)
Report = Callable[[int], object]
Writer = Callable[[Path, Report], None]


@dataclass
class Row:
    """What happened to writers of one kind."""

    what: str
    events: int = 0
    streams: int = 0
    equal: int = 0
    reported_frames_lost: int = 0
    reads_refused: int = 0
    seconds_until_normal: list[float] = field(default_factory=list)


@dataclass(frozen=True)
class Sent:
    """A stream to send.

    Args:
        header: its header.
        packets: its packets.
        whole: its bytes as a file.
        begins: frames with which other periods begin, all with the same header.
    """

    header: StreamHeader
    packets: list[Packet]
    whole: bytes
    begins: frozenset[int] = frozenset()

    def begins_period(self, index: int) -> bool:
        """Whether frame ``index`` begins another period when the stream is sent again and again."""
        at = index % len(self.packets)
        return bool(self.begins) and index > 0 and (not at or at in self.begins)


def renumbered(packet: Packet, index: int, *, fps: float) -> Packet:
    """The packet as that of another frame."""
    payload = FRAME.pack(index, index / fps) + packet.payload[FRAME.size :]
    return replace(packet, index=index, pts_seconds=index / fps, payload=payload)


def repeated(reader: StreamReader, *, frames: int, each_a_period: bool = False) -> Sent:
    """A stream of ``frames`` packets, which are those of ``reader`` again and again with other numbers and times.

    With ``each_a_period`` every repetition is another period. Its containers are right; decoding it makes no sense.
    """
    begins = frozenset(range(len(reader), frames, len(reader))) if each_a_period else frozenset[int]()
    header = replace(reader.header, periods=each_a_period)
    packets = []
    for index in range(frames):
        (*_, one) = reader.group(index % len(reader))
        packets.append(renumbered(one, index, fps=reader.header.fps))
    sink = MemorySink()
    sink.open(header)
    for packet in packets:
        if packet.index in begins:
            sink.begin(header)
        sink.write(packet)
    sink.close()
    return Sent(header, packets, sink.data, begins)


def segments_writer(sent: Sent) -> Writer:
    """Writes packets as segments."""

    def write(path: Path, report: Report) -> None:
        store = FolderStore(path)
        store.prepare()
        sink, resumed = resume_segments(store, options=OPTIONS)
        send(sink, sent, 0 if resumed is None else len(resumed), report)

    return write


def file_writer(sent: Sent) -> Writer:
    """Writes packets as a file."""

    def write(path: Path, report: Report) -> None:
        sink, resumed = FileSink.resume(path)
        send(sink, sent, 0 if resumed is None else len(resumed), report)

    return write


def send(sink: PacketSink, sent: Sent, start: int, report: Report) -> None:
    """Write a stream from packet ``start`` on."""
    sink.open(sent.header)
    for packet in sent.packets[start:]:
        time.sleep(PACE_SECONDS)
        if sent.begins_period(packet.index):
            sink.begin(sent.header)
        sink.write(packet)
        report(packet.index)
    sink.close()


def real_writer(frames: int) -> Writer:
    """Reconstructs the bundled clip with the preset tiny and next to no iterations."""

    def write(path: Path, report: Report) -> None:
        from structgstream.data.dataset_layouts import bundled_clip_path
        from structgstream.data.open import open_capture
        from structgstream.kernels.backend import select_backend
        from structgstream.recorder import record, segments_at, segments_folder
        from structgstream.session.struct_gstream import stream_pipeline
        from tests.support.small_presets import QUICK  # which needs pytest

        config = replace(QUICK, key_interval_seconds=0.1)
        source = open_capture(bundled_clip_path(), scale=0.25, frames=frames)
        storage = segments_at(segments_folder(path, may_exist=True), options=OPTIONS)
        run = record(
            path, source, stream_pipeline(config), select_backend("cpu"), resume=(path / "manifest.json").exists(),
            storage=storage,
        )  # fmt: skip
        for one in run.reports:
            report(one.index)

    return write


def edge_of(path: Path) -> int:
    """The last frame that a writer would go on after; -1 without any."""
    if path.is_file():
        with suppress(StreamError):
            return len(open_stream(path)) - 1
        return -1
    found = None
    with suppress(StreamError):
        found = find(FolderStore(path)) if path.is_dir() else None
    return -1 if found is None else found.manifest.edge.frame


def readable(path: Path, whole: bytes) -> bool:
    """Whether a reader who knows nothing of a kill finds a beginning of the stream, with the right hashes."""
    try:
        if path.is_file():
            return len(open_stream(path)) > 0
        store = FolderStore(path)
        if not (path / "manifest.json").exists():
            return edge_of(path) <= 0  # Killed between the first part and the first manifest.
        stored = StoredBytes(store, read_manifest(store), check=True)
        found = stored[:]
        return whole.startswith(found[: footer_offset(found)])  # An orderly end has an index.
    except StreamError:
        return False


def content(path: Path, *, beside: Path | None = None) -> bytes:
    """The stream as a file; an archive is made in the folder ``beside``, by default that of the stream."""
    if path.is_file():
        return path.read_bytes()
    archive = (beside or path.parent) / "archive.sgs"
    write_archive(FolderStore(path), archive)
    data = archive.read_bytes()
    archive.unlink()
    return data
