# SPDX-License-Identifier: Apache-2.0
"""Finds a stream that a writer left, stopped or killed at any moment (``sink``, Note [Order of writing]).

A killed writer leaves a manifest, and at most what came after it: the part of one more frame, the segment that this
frame's group follows, history pages. The part counts; everything else is made again, with the same names and bytes.
"""

import re
from dataclasses import replace

from structgstream.codec.container.records import PREFIX, PacketKind, RecordType, check_prefix, read_record
from structgstream.codec.header import unpack_header
from structgstream.codec.segments.history import verified
from structgstream.codec.segments.manifest import (
    MANIFEST,
    MAX_MANIFEST_BYTES,
    Edge,
    Manifest,
    PartEntry,
    manifest_from_json,
    sha256_of,
)
from structgstream.codec.segments.next_manifest import (
    Draft,
    empty_manifest,
    next_segment,
    part_of,
    period_entry,
    reopened,
    running_period,
    with_frame,
    with_segment,
    without_empty_period,
)
from structgstream.codec.segments.store import Store
from structgstream.errors import StreamError

_NAME = re.compile(r"(init|part|segment|history)-(\d+)-([0-9a-f]{16})\.")


def find(store: Store) -> Draft | None:
    """The stream in a store with every frame that was written, to go on after it.

    None if there is no whole frame: the stream then begins again. Nothing is changed.

    Raises:
        StreamError: the store cannot be read, or what is there is damaged so that it cannot be continued.
    """
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

    The first segment of the running period stays: resuming needs its first frame.
    """
    first, listed = manifest.window.first_segment, min([entry.segment for entry in manifest.segments] or [0])
    listed = listed if manifest.segments else next_segment(manifest)
    kept = running_period(manifest).first_segment
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
    data = store.get(MANIFEST, max_bytes=MAX_MANIFEST_BYTES)
    manifest = manifest_from_json(data, name=f"{MANIFEST} in {store.name}")
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
