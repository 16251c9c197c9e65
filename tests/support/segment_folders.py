# SPDX-License-Identifier: Apache-2.0
"""Folders of segments that grow frame by frame, as a sink writes them, from the bytes of a finished stream."""

from dataclasses import replace
from pathlib import Path

from structgstream.codec.container.records import PREFIX, RecordType, read_record, scan_records
from structgstream.codec.packets import PacketKind, parse_packet
from structgstream.codec.segments.manifest import (
    MANIFEST,
    Edge,
    Manifest,
    PartEntry,
    SegmentEntry,
    Window,
    manifest_to_json,
)
from structgstream.codec.segments.recovery import part_of, period_entry, segment_of
from structgstream.codec.segments.store import FolderStore

_KINDS = {RecordType.KEY: PacketKind.KEY, RecordType.DELTA: PacketKind.DELTA}


class GrowingFolder:
    """A segments folder of ``stream``, without any frame yet; :meth:`write` adds one after the other.

    Attributes:
        manifest: what was written last; None before the first frame.
        frames: number of frames of the stream.
    """

    def __init__(self, folder: Path, stream: bytes, *, name: str = "test") -> None:
        self.folder = folder
        self.manifest: Manifest | None = None
        self._store = FolderStore(folder)
        self._store.prepare()
        init = read_record(stream, PREFIX.size)
        assert init is not None
        records = [one for one in scan_records(stream, init.end) if one.type in _KINDS]
        self._packets = [(parse_packet(one.payload, _KINDS[RecordType(one.type)]), one) for one in records]
        self._stream, self._name = stream, name
        self.frames = len(records)
        data = stream[: init.end]
        self._period = period_entry(data, 0, first_frame=0, first_segment=0)
        self._store.put(self._period.file, data)

    def write(self) -> Manifest:
        """The next frame: a part, before it the segment that its key packet ends, and the manifest."""
        frame = 0 if self.manifest is None else self.manifest.edge.frame + 1
        packet, record = self._packets[frame]
        segments = () if self.manifest is None else self.manifest.segments
        parts = () if self.manifest is None else self.manifest.parts
        if packet.kind is PacketKind.KEY and parts:
            segments, parts = (*segments, self._segment(segments, parts)), ()
        data = self._stream[record.offset : record.end]
        part = part_of(data)
        self._store.put(part.file, data)
        return self._publish(
            Manifest(
                sequence=frame + 1,
                live=True,
                fps=30.0,
                name=self._name,
                target_latency_seconds=2.0,
                frame_seconds=1.0 if frame else None,
                edge=Edge(frame, packet.pts_seconds, None, 1.7e9 + frame),
                window=Window(0, 0, None),
                periods=(self._period,),
                history=(),
                segments=segments,
                parts=(*parts, part),
            )
        )

    def write_all(self) -> Manifest:
        """All frames that are left, and the end."""
        for _ in range(self.frames if self.manifest is None else self.frames - self.manifest.edge.frame - 1):
            self.write()
        return self.finish()

    def finish(self) -> Manifest:
        """The end of the run: the last group as a segment."""
        now = self.manifest
        assert now is not None
        segments = (*now.segments, self._segment(now.segments, now.parts))
        return self._publish(replace(now, sequence=now.sequence + 1, live=False, segments=segments, parts=()))

    def _segment(self, before: tuple[SegmentEntry, ...], parts: tuple[PartEntry, ...]) -> SegmentEntry:
        data = b"".join(self._store.get(part.file) for part in parts)
        entry = segment_of(parts, data, segment=len(before))
        self._store.put(entry.file, data)
        return entry

    def _publish(self, manifest: Manifest) -> Manifest:
        self._store.put(MANIFEST, manifest_to_json(manifest))
        self.manifest = manifest
        return manifest
