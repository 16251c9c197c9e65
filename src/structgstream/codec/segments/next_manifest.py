# SPDX-License-Identifier: Apache-2.0
"""From one manifest to the next, with the group of frames that is being written, and the files before it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from structgstream.codec.container.records import (
    FRAME,
    PACKET_KINDS,
    RecordType,
    packed,
    prefix,
    read_record,
)
from structgstream.codec.header import pack_header
from structgstream.codec.packets import StreamHeader
from structgstream.codec.segments.history import paged, verified
from structgstream.codec.segments.manifest import (
    Edge,
    Manifest,
    PartEntry,
    PeriodEntry,
    SegmentEntry,
    Window,
    init_name,
    part_name,
    segment_name,
    sha256_of,
)
from structgstream.codec.segments.store import Store
from structgstream.errors import StreamError


def part_of(record: bytes) -> PartEntry:
    """The entry of a packet's record.

    Raises:
        StreamError: it is no whole record of a packet.
    """
    found = read_record(record, 0)
    if found is None or found.type not in PACKET_KINDS or len(found.payload) < FRAME.size:
        raise StreamError(f"{len(record)} bytes are no whole record of a packet.")
    frame, pts_seconds = FRAME.unpack_from(found.payload)
    sha256 = sha256_of(record)
    kind = PACKET_KINDS[found.type]
    return PartEntry(part_name(frame, sha256), frame, found.period, kind, pts_seconds, len(record), sha256)


def segment_of(parts: Sequence[PartEntry], data: bytes, *, segment: int) -> SegmentEntry:
    """The entry of the segment that consists of these parts, whose bytes are ``data``."""
    sha256 = sha256_of(data)
    return SegmentEntry(
        segment=segment,
        file=segment_name(segment, sha256),
        period=parts[0].period,
        first_frame=parts[0].frame,
        frames=len(parts),
        pts_seconds=(parts[0].pts_seconds, parts[-1].pts_seconds),
        bytes=len(data),
        key_bytes=parts[0].bytes,
        frame_bytes=tuple(part.bytes for part in parts),
        sha256=sha256,
    )


def records_of(entry: SegmentEntry, data: bytes) -> list[bytes]:
    """The records of each frame of a segment."""
    records, start = [], 0
    for size in entry.frame_bytes:
        records.append(data[start : start + size])
        start += size
    return records


@dataclass(frozen=True)
class Draft:
    """A manifest to write.

    Args:
        manifest: with ``parts`` of the group that is being written.
        records: of each of these parts.
        files: names and contents of other files that must be there before the manifest.
    """

    manifest: Manifest
    records: tuple[bytes, ...] = ()
    files: tuple[tuple[str, bytes], ...] = ()


def init_file(header: StreamHeader, number: int) -> bytes:
    """The file of a period: prefix and init record."""
    return prefix(periods=header.periods or number > 0) + packed(RecordType.INIT, pack_header(header), period=number)


def period_entry(data: bytes, number: int, *, first_frame: int, first_segment: int) -> PeriodEntry:
    """The entry of a period whose file is ``data``."""
    sha256 = sha256_of(data)
    return PeriodEntry(number, init_name(number, sha256), len(data), sha256, first_frame, first_segment)


def empty_manifest(header: StreamHeader, period: PeriodEntry, *, sequence: int = 0) -> Manifest:
    """A manifest before the first frame; it is not written."""
    return Manifest(
        sequence=sequence,
        live=True,
        fps=header.fps,
        # A folder's name may hold bytes that are no text, which Python keeps as halves of characters.
        name=str(header.metadata.get("capture", "")).encode(errors="replace").decode()[:1000],
        target_latency_seconds=0.0,
        frame_seconds=None,
        edge=Edge(-1, 0.0, None, 0.0),
        window=Window(0, 0, None),
        periods=(period,),
        history=(),
        segments=(),
        parts=(),
    )


def with_frame(draft: Draft, part: PartEntry, record: bytes, edge: Edge) -> Draft:
    """With one more frame in the group that is being written: its part, and the record that this is."""
    manifest = draft.manifest
    manifest = replace(manifest, live=True, edge=edge, parts=(*manifest.parts, part))
    return replace(draft, manifest=manifest, records=(*draft.records, record))


def with_segment(draft: Draft) -> Draft:
    """With the group that is being written as a segment, if there is one."""
    manifest = draft.manifest
    if not draft.records:
        return draft
    data = b"".join(draft.records)
    entry = segment_of(manifest.parts, data, segment=next_segment(manifest))
    found = paged(manifest.history, (*manifest.segments, entry))
    manifest = replace(manifest, history=found.history, segments=found.segments, parts=())
    return Draft(manifest, (), (*draft.files, (entry.file, data), *found.pages))


def reopened(draft: Draft, store: Store) -> Draft:
    """With the last segment, which an orderly stop has closed early, as the group that is being written.

    Raises:
        StreamError: the segment is missing or damaged.
    """
    manifest = draft.manifest
    *before, last = manifest.segments
    records = records_of(last, verified(store, last))
    parts = tuple(part_of(record) for record in records)
    files = tuple((part.file, record) for part, record in zip(parts, records, strict=True))
    return Draft(replace(manifest, segments=tuple(before), parts=parts), tuple(records), (*draft.files, *files))


def next_segment(manifest: Manifest) -> int:
    """Number of the segment after the last one."""
    if manifest.segments:
        return manifest.segments[-1].segment + 1
    return manifest.history[-1].first_segment + manifest.history[-1].segments if manifest.history else 0


def running_period(manifest: Manifest) -> PeriodEntry:
    """The period of the newest frame; before the first frame, the first."""
    frame = max(manifest.edge.frame, manifest.periods[0].first_frame)
    return [period for period in manifest.periods if period.first_frame <= frame][-1]


def without_empty_period(manifest: Manifest) -> Manifest:
    """Without a period that no frame of the manifest belongs to: its first frame was never written."""
    last = running_period(manifest)
    return replace(manifest, periods=tuple(one for one in manifest.periods if one.period <= last.period))


def with_period(draft: Draft, header: StreamHeader) -> Draft:
    """With another period, which begins with the next frame; it is named before there is a frame of it.

    So whoever goes on after a kill finds the init record of a frame that no manifest names, and players fetch it while
    they show the frames before.
    """
    manifest = without_empty_period(draft.manifest)
    number = manifest.periods[-1].period + 1
    data = init_file(header, number)
    segment = next_segment(manifest) + (1 if manifest.parts else 0)
    entry = period_entry(data, number, first_frame=manifest.edge.frame + 1, first_segment=segment)
    periods = (*manifest.periods, entry)
    return replace(draft, manifest=replace(manifest, periods=periods), files=(*draft.files, (entry.file, data)))


def periods_in(periods: Sequence[PeriodEntry], window: Window) -> tuple[PeriodEntry, ...]:
    """The periods of which something is in the window."""
    first = max(i for i, period in enumerate(periods) if i == 0 or period.first_frame <= window.first_frame)
    return tuple(periods[first:])
