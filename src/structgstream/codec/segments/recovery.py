# SPDX-License-Identifier: Apache-2.0
"""From one manifest to the next; and the stream that a writer left, stopped or killed at any moment.

A killed writer (``sink``, Note [Order of writing]) leaves a manifest, and at most what came after it: the part of one
more frame, the segment that this frame's group follows, history pages. The part counts; everything else is made again,
with the same names and bytes.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import accumulate

from structgstream.codec.container.records import (
    FRAME,
    PACKET_KINDS,
    PREFIX,
    PacketKind,
    RecordType,
    check_prefix,
    packed,
    prefix,
    read_record,
)
from structgstream.codec.packets import StreamHeader, pack_header, unpack_header
from structgstream.codec.segments.manifest import (
    MANIFEST,
    Edge,
    Manifest,
    PartEntry,
    PeriodEntry,
    SegmentEntry,
    Window,
    file_name,
    sha256_of,
)
from structgstream.codec.segments.store import Store
from structgstream.codec.segments.stored_bytes import paged, read_manifest, verified
from structgstream.errors import StreamError


def part_of(record: bytes) -> PartEntry:
    """The entry of a packet's record. Raises StreamError if it is no whole record of a packet."""
    found = read_record(record, 0)
    if found is None or found.type not in PACKET_KINDS or len(found.payload) < FRAME.size:
        raise StreamError(f"{len(record)} bytes are no whole record of a packet.")
    frame, pts_seconds = FRAME.unpack_from(found.payload)
    sha256 = sha256_of(record)
    kind = PACKET_KINDS[found.type]
    return PartEntry(file_name("part", frame, sha256), frame, found.period, kind, pts_seconds, len(record), sha256)


def segment_of(parts: Sequence[PartEntry], data: bytes, *, segment: int) -> SegmentEntry:
    """The entry of the segment that consists of these parts, whose bytes are ``data``."""
    sha256 = sha256_of(data)
    return SegmentEntry(
        segment=segment,
        file=file_name("segment", segment, sha256),
        period=parts[0].period,
        first_frame=parts[0].frame,
        frames=len(parts),
        pts_seconds=(parts[0].pts_seconds, parts[-1].pts_seconds),
        bytes=len(data),
        key_bytes=parts[0].bytes,
        frame_bytes=tuple(part.bytes for part in parts),
        sha256=sha256,
    )


@dataclass(frozen=True)
class Draft:
    """A manifest to write."""

    manifest: Manifest  # with parts of the group that is being written
    records: tuple[bytes, ...] = ()  # of each of these parts
    # names and contents of other files that must be there before the manifest
    files: tuple[tuple[str, bytes], ...] = ()


def init_file(header: StreamHeader, number: int) -> bytes:
    """The file of a period: prefix and init record."""
    start = prefix(periods=header.periods or number > 0, sound=header.sound is not None)
    return start + packed(RecordType.INIT, pack_header(header), period=number)


def period_entry(data: bytes, number: int, *, first_frame: int, first_segment: int) -> PeriodEntry:
    """The entry of a period whose file is ``data``."""
    sha256 = sha256_of(data)
    return PeriodEntry(number, file_name("init", number, sha256), len(data), sha256, first_frame, first_segment)


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
    """``draft`` with one more frame in the group that is being written; ``record`` is the content of the file that
    ``part`` describes."""
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
    """With the last segment, which an orderly stop has closed early, as the group that is being written. Raises
    StreamError if the segment is missing or damaged."""
    manifest = draft.manifest
    *before, last = manifest.segments
    data, ends = verified(store, last), accumulate(last.frame_bytes)
    records = tuple(data[end - size : end] for size, end in zip(last.frame_bytes, ends))
    parts = tuple(map(part_of, records))
    files = ((part.file, record) for part, record in zip(parts, records))
    return Draft(replace(manifest, segments=tuple(before), parts=parts), records, (*draft.files, *files))


def next_segment(manifest: Manifest) -> int:
    """Number of the segment after the last one."""
    last = [*manifest.history, *manifest.segments][-1:]
    return last[0].first_segment + last[0].segments if last else 0


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


_NAME = re.compile(r"(init|part|segment|history)-(\d+)-([0-9a-f]{16})\.")


def find(store: Store) -> Draft | None:
    """The stream in a store with every frame that was written, to go on after it; None if there is no whole frame: the
    stream then begins again. Nothing is changed. Raises StreamError if the store cannot be read, or what is there is
    damaged so that it cannot be continued."""
    there = store.names()
    draft = _named(store, there) if MANIFEST in there else _unnamed(store, there)
    if draft is None:
        return None
    while (found := _unnamed_part(store, there, draft.manifest)) is not None:
        part, record = found
        if part.kind is PacketKind.KEY:
            draft = with_segment(draft)
        elif not draft.records:
            draft = reopened(draft, store)
        published = draft.manifest.edge.published_unix_seconds
        draft = with_frame(draft, part, record, Edge(part.frame, part.pts_seconds, None, published))
    return None if draft.manifest.edge.frame < 0 else replace(draft, manifest=without_empty_period(draft.manifest))


def stale_files(manifest: Manifest, there: frozenset[str]) -> frozenset[str]:
    """Those of the files ``there`` that this manifest and its pages do not name, or that have left its window.

    The first segment of the running period is kept, because resuming needs its first frame. History pages are always
    kept, because other pages may name them.
    """
    first, kept = manifest.window.first_segment, running_period(manifest).first_segment
    listed = manifest.segments[0].segment if manifest.segments else next_segment(manifest)
    named = {entry.file for entry in (*manifest.periods, *manifest.history, *manifest.parts)}
    named |= {one.file for one in manifest.segments if one.segment >= first or one.segment == kept} | {MANIFEST}
    stale = set()
    for name in there - named:
        match = _NAME.match(name)
        kind, number = (match[1], int(match[2])) if match else ("", 0)
        on_a_page = kind == "segment" and number < listed and (number >= first or number == kept)
        if kind != "history" and not on_a_page:
            stale.add(name)
    return frozenset(stale)


def _named(store: Store, there: frozenset[str]) -> Draft | None:
    """What the manifest names; a damaged last part is as one that was never written."""
    manifest = read_manifest(store)
    segments = [entry for entry in manifest.segments if entry.segment >= manifest.window.first_segment]
    for entry in (*manifest.periods, *manifest.history, *segments):
        if entry.file not in there:
            raise StreamError(
                f"Cannot continue {store.name}: its manifest names {entry.file}, which is missing. Put it back, or "
                "start again with --overwrite."
            )
    records = []
    for part in manifest.parts:
        try:
            records.append(verified(store, part))
        except StreamError as error:
            if part is not manifest.parts[-1]:
                raise StreamError(
                    f"Cannot continue {store.name}: {error} Continuing would lose the frames after it. Keep a copy; "
                    "then start again with --overwrite."
                ) from error
            return _without_last(manifest, tuple(records))
    return Draft(manifest, tuple(records))


def _without_last(manifest: Manifest, records: tuple[bytes, ...]) -> Draft | None:
    """Without the last part."""
    parts = manifest.parts[:-1]
    if parts:
        frame, pts_seconds = parts[-1].frame, parts[-1].pts_seconds
    elif manifest.segments:
        last = manifest.segments[-1]
        frame, pts_seconds = last.first_frame + last.frames - 1, last.pts_seconds[1]
    else:
        return None
    edge = replace(manifest.edge, frame=frame, pts_seconds=pts_seconds, captured_unix_seconds=None)
    return Draft(replace(manifest, edge=edge, parts=parts), records)


def _unnamed(store: Store, there: frozenset[str]) -> Draft | None:
    """The stream before its first manifest: an init record, whose first frame may be there."""
    found = [match for name in there if (match := _NAME.match(name))]
    if any(match[1] in ("segment", "history") or (match[1] == "part" and int(match[2])) for match in found):
        raise StreamError(
            f"Cannot continue {store.name}: it has frames of a stream, but no {MANIFEST}. Put it back, or start again "
            "with --overwrite."
        )
    inits = [match.string for match in found if match[1] == "init"]
    if len(inits) != 1:
        return None
    data = store.get(inits[0])
    if sha256_of(data)[:16] not in inits[0]:
        return None
    check_prefix(data, f"{inits[0]} in {store.name}")
    record = read_record(data, PREFIX.size)
    if record is None or record.type != RecordType.INIT:
        return None
    period = period_entry(data, 0, first_frame=0, first_segment=0)
    return Draft(empty_manifest(unpack_header(record.payload), period))


def _unnamed_part(store: Store, there: frozenset[str], manifest: Manifest) -> tuple[PartEntry, bytes] | None:
    """The frame after the edge, if its part is whole; a part that is not was never reported as written."""
    frame = manifest.edge.frame + 1
    for name in sorted(there):
        match = _NAME.match(name)
        if match is None or (match[1], int(match[2])) != ("part", frame):
            continue
        record = store.get(name)
        if sha256_of(record)[:16] != match[3]:
            continue
        part = part_of(record)
        later = frame == 0 or part.pts_seconds > manifest.edge.pts_seconds
        if part.frame == frame and later and part.period == manifest.periods[-1].period:
            return part, record
    return None
