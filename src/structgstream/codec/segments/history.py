# SPDX-License-Identifier: Apache-2.0
"""Older segments leave the manifest for pages, and older pages for pages of pages (docs/segments.md, History)."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from structgstream.codec.segments.manifest import (
    LISTED_SEGMENTS,
    PAGE_FRAMES,
    PAGE_SEGMENTS,
    HistoryEntry,
    SegmentEntry,
    StoredFile,
    history_name,
    page_from_json,
    page_to_json,
    sha256_of,
)
from structgstream.codec.segments.store import Store
from structgstream.errors import StreamError


@dataclass(frozen=True)
class Paged:
    """Entries of a manifest after some have moved to ``pages``, which are name and content of new files."""

    history: tuple[HistoryEntry, ...]
    segments: tuple[SegmentEntry, ...]
    pages: tuple[tuple[str, bytes], ...]


def paged(history: Sequence[HistoryEntry], segments: Sequence[SegmentEntry]) -> Paged:
    """Moves older entries to pages once there are enough of them; the newest segments stay."""
    pages: list[tuple[str, bytes]] = []
    older = segments[:-LISTED_SEGMENTS]
    if len(older) >= PAGE_SEGMENTS or sum(entry.frames for entry in older) >= PAGE_FRAMES:
        history = (*history, _page(older, 0, pages))
        segments = segments[len(older) :]
    level = 0
    while sum(entry.level == level for entry in history) >= PAGE_SEGMENTS:
        start = next(i for i, entry in enumerate(history) if entry.level == level)
        end = start + PAGE_SEGMENTS
        history = (*history[:start], _page(history[start:end], level + 1, pages), *history[end:])
        level += 1
    return Paged(tuple(history), tuple(segments), tuple(pages))


def _page(
    entries: Sequence[SegmentEntry] | Sequence[HistoryEntry], level: int, pages: list[tuple[str, bytes]]
) -> HistoryEntry:
    """The entry of a page of ``entries``, which is added to ``pages``."""
    data = page_to_json(entries)
    sha256 = sha256_of(data)
    first = entries[0]
    number = first.segment if isinstance(first, SegmentEntry) else first.first_segment
    pages.append((history_name(number, sha256), data))
    return HistoryEntry(
        file=pages[-1][0],
        level=level,
        first_segment=number,
        segments=sum(1 if isinstance(entry, SegmentEntry) else entry.segments for entry in entries),
        first_frame=first.first_frame,
        frames=sum(entry.frames for entry in entries),
        pts_seconds=(first.pts_seconds[0], entries[-1].pts_seconds[1]),
        bytes=len(data),
        sha256=sha256,
    )


def segments_from(
    store: Store,
    history: Sequence[HistoryEntry],
    segments: Sequence[SegmentEntry],
    *,
    first: int = 0,
    held: Mapping[str, bytes] | None = None,
) -> Iterator[SegmentEntry]:
    """Every segment from number ``first`` on, those on pages included.

    Args:
        store: has the pages.
        history: pages of older segments.
        segments: the segments after them.
        first: number of the first segment to give.
        held: contents of pages that are not in the store yet.

    Raises:
        StreamError: a page is missing, damaged, or not what is announced.
    """
    for entry in history:
        if entry.first_segment + entry.segments > first:
            data = held[entry.file] if held and entry.file in held else verified(store, entry)
            found = page_from_json(data, entry)
            pages = [one for one in found if isinstance(one, HistoryEntry)]
            listed = [one for one in found if isinstance(one, SegmentEntry)]
            yield from segments_from(store, pages, listed, first=first, held=held)
    yield from (entry for entry in segments if entry.segment >= first)


def verified(store: Store, entry: StoredFile) -> bytes:
    """The content of the file that an entry names.

    Raises:
        StreamError: it is missing, or is not what the entry states.
    """
    data = store.get(entry.file)
    if len(data) != entry.bytes or sha256_of(data) != entry.sha256:
        raise StreamError(
            f"{entry.file} in {store.name} is damaged: it has {len(data)} bytes with the SHA-256 "
            f"{sha256_of(data)[:16]}...; the manifest states {entry.bytes} bytes and {entry.sha256[:16]}..."
        )
    return data
