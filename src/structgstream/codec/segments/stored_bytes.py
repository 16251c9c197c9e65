# SPDX-License-Identifier: Apache-2.0
"""A stream of segments as the bytes of a stream file, with its older segments on pages (docs/segments.md, History)."""

from bisect import bisect_right
from collections import OrderedDict
from collections.abc import Iterator, Mapping, Sequence, Set
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path

from structgstream.atomic_files import atomic_write
from structgstream.codec.container.records import PREFIX, RECORD_TYPES, PacketKind, Period, RecordType, pack_index
from structgstream.codec.segments.manifest import (
    LISTED_SEGMENTS,
    MANIFEST,
    MAX_MANIFEST_BYTES,
    PAGE_FRAMES,
    PAGE_SEGMENTS,
    HistoryEntry,
    Manifest,
    PartEntry,
    SegmentEntry,
    StoredFile,
    file_name,
    manifest_from_json,
    page_from_json,
    page_to_json,
    sha256_of,
)
from structgstream.codec.segments.quality_list import read_list
from structgstream.codec.segments.store import FolderStore, Store
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
    pages.append((file_name("history", first.first_segment, sha256), data))
    return HistoryEntry(
        file=pages[-1][0],
        level=level,
        first_segment=first.first_segment,
        segments=sum(entry.segments for entry in entries),
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
    """Every segment from number ``first`` on, those on pages included; ``held`` are contents of pages that are not in
    the store yet. Raises StreamError if a page is missing, damaged, or not what is announced."""
    for entry in history:
        if entry.first_segment + entry.segments > first:
            data = held[entry.file] if held and entry.file in held else verified(store, entry)
            found = page_from_json(data, entry)
            pages = [one for one in found if isinstance(one, HistoryEntry)]
            listed = [one for one in found if isinstance(one, SegmentEntry)]
            yield from segments_from(store, pages, listed, first=first, held=held)
    yield from (entry for entry in segments if entry.segment >= first)


def verified(store: Store, entry: StoredFile) -> bytes:
    """The content of the file that an entry names. Raises StreamError if it is missing, or is not what the entry
    states."""
    data = store.get(entry.file)
    if len(data) != entry.bytes or sha256_of(data) != entry.sha256:
        raise StreamError(
            f"{entry.file} in {store.name} is damaged: it has {len(data)} bytes with the SHA-256 "
            f"{sha256_of(data)[:16]}...; the manifest states {entry.bytes} bytes and {entry.sha256[:16]}..."
        )
    return data


_KEPT_FILES = 2


@dataclass(frozen=True)
class _Piece:
    """A file without its first ``skipped`` bytes, or an own sequence of bytes, and where it begins."""

    start: int
    content: StoredFile | bytes
    skipped: int = 0


class StoredBytes:
    """The bytes of the stream file that the run would have written instead of segments, read on demand.

    Init record, segments, parts; with index and footer once the run has ended. Segments that have left the window, and
    are no longer there, are left out: :attr:`gone` has their frames.

    Args:
        held: contents of files that are not in the store yet.
        check: verify the SHA-256 of every file; otherwise only lengths, and readers verify records.

    Attributes:
        gone: frames that are no longer there, in order.
        sizes: of every frame from 0 on, in bytes, gone ones included.
        kinds: of every frame.
        seconds: presentation time of every frame; those within a segment are interpolated between its first and last.
        periods: those of all frames; of one that is no longer there, offset and length are 0.

    Raises:
        StreamError: a file is missing or not what the manifest states; also on slicing.
    """

    def __init__(
        self, store: Store, manifest: Manifest, *, held: Mapping[str, bytes] | None = None, check: bool = False
    ) -> None:
        self._store = store
        self._held = dict(held or {})
        self._check = check
        self._pieces: list[_Piece] = []
        self._size = 0
        self._cache: OrderedDict[str, bytes] = OrderedDict()
        self.gone: list[range] = []
        self.sizes: list[int] = []
        self.kinds: list[PacketKind] = []
        self.seconds: list[float] = []
        self.periods: list[Period] = []
        self._periods = {period.period: period for period in manifest.periods}
        self._period: int | None = None  # whose init record has been added
        self._index: list[tuple[int, int, int]] = []  # its entries
        there = store.names() | self._held.keys()
        segments = segments_from(store, manifest.history, manifest.segments, held=self._held)
        for entry in chain(segments, manifest.parts):
            self._add_frames(entry, there, first_segment=manifest.window.first_segment)
        if not manifest.live:
            self._add(pack_index(self._index, self._size))

    def __len__(self) -> int:
        return self._size

    def __getitem__(self, key: slice, /) -> bytes:
        start, stop, _ = key.indices(self._size)
        found = bytearray()
        place = bisect_right(self._pieces, start, key=lambda piece: piece.start) - 1
        while len(found) < stop - start:
            piece = self._pieces[place]
            at = start + len(found) - piece.start
            found += self._content(piece)[at : stop - piece.start]
            place += 1
        return bytes(found)

    def __enter__(self) -> "StoredBytes":
        return self

    def __exit__(self, *raised: object) -> None:
        self.close()

    def close(self) -> None:
        """Nothing is open between calls; what was read is forgotten."""
        self._cache.clear()

    def files(self) -> Iterator[bytes]:
        """The contents of all files in order, each read once."""
        for piece in self._pieces:
            yield self._content(piece)

    def _add(self, content: StoredFile | bytes, *, skipped: int = 0) -> None:
        self._pieces.append(_Piece(self._size, content, skipped))
        self._size += (len(content) if isinstance(content, bytes) else content.bytes) - skipped

    def _add_period(self, number: int, frame: int) -> None:
        """Add the init record of a period, whose first frame that is there follows, if it is another than before."""
        if number == self._period:
            return
        if number not in self._periods:
            raise StreamError(f"{self._store.name} has frame {frame}, and no init record of its period {number}.")
        first = self._period is None
        self._period = number
        if not first:
            self._index.append((frame, RecordType.INIT, self._size))
        # Every file of a period begins with a prefix, and a stream has one.
        offset, size = self._size + (PREFIX.size if first else 0), self._periods[number].bytes - PREFIX.size
        self.periods[-1] = replace(self.periods[-1], offset=offset, bytes=size)
        self._add(self._periods[number], skipped=0 if first else PREFIX.size)

    def _add_frames(self, entry: SegmentEntry | PartEntry, there: Set[str], *, first_segment: int) -> None:
        """Add a segment or a part, if it is ``there``, and what an index says of it; the window begins with
        ``first_segment``."""
        if isinstance(entry, PartEntry):
            first, sizes, kinds, seconds = entry.frame, (entry.bytes,), [entry.kind], [entry.pts_seconds]
        else:
            first, sizes = entry.first_frame, entry.frame_bytes
            kinds = [PacketKind.KEY, *[PacketKind.DELTA] * (entry.frames - 1)]
            seconds = _evenly(*entry.pts_seconds, entry.frames)
        if not self.periods or self.periods[-1].number != entry.period:
            self.periods.append(Period(entry.period, first, 0, 0))
        self.sizes += sizes
        self.kinds += kinds
        self.seconds += seconds
        left = isinstance(entry, SegmentEntry) and entry.segment < first_segment
        # In its time of grace a segment is there, though the manifest no longer names its period's init record.
        if entry.file not in there or (left and entry.period not in self._periods):
            if not left:
                raise StreamError(f"{self._store.name} has no {entry.file}, which its manifest names.")
            last = self.gone.pop() if self.gone and self.gone[-1].stop == first else range(first, first)
            self.gone.append(range(last.start, first + len(sizes)))
            return
        self._add_period(entry.period, first)
        offset = self._size
        for index, (size, kind) in enumerate(zip(sizes, kinds, strict=True), start=first):
            self._index.append((index, RECORD_TYPES[kind], offset))
            offset += size
        self._add(entry)

    def _content(self, piece: _Piece) -> bytes:
        content = piece.content
        if isinstance(content, bytes):
            return content
        name = content.file
        if name not in self._cache:
            self._cache[name] = self._held[name] if name in self._held else self._read(content)
            if len(self._cache) > _KEPT_FILES:
                self._cache.popitem(last=False)
        return self._cache[name][piece.skipped :]

    def _read(self, entry: StoredFile) -> bytes:
        if self._check:
            return verified(self._store, entry)
        data = self._store.get(entry.file, max_bytes=entry.bytes)
        if len(data) != entry.bytes:
            raise StreamError(
                f"{entry.file} in {self._store.name} has {len(data)} bytes; the manifest states {entry.bytes}."
            )
        return data


def open_segments(path: Path | str) -> StoredBytes:
    """The bytes of a stream in a folder. Raises StreamError if there is no manifest, or it is not valid, or a file is
    missing."""
    path = Path(path)
    store = FolderStore(path.parent if path.name == MANIFEST else path)
    if not (path / MANIFEST).exists() and (listed := read_list(path)) is not None:
        folders = ", ".join(str((path / one.manifest).parent) for one in listed)
        raise StreamError(f"{path} holds several qualities of one stream; give the folder of one: {folders}.")
    return StoredBytes(store, read_manifest(store))


def is_segments(path: Path | str) -> bool:
    """Whether :func:`open_segments` is for this path: a folder, or a manifest's name."""
    path = Path(path)
    return path.name == MANIFEST or path.is_dir()


def read_manifest(store: Store) -> Manifest:
    """The manifest of a stream of segments. Raises StreamError if there is none, or it is not valid."""
    if MANIFEST not in store.names():
        raise StreamError(f"{store.name} has no {MANIFEST}; expected a folder written with --sink segments.")
    return manifest_from_json(store.get(MANIFEST, max_bytes=MAX_MANIFEST_BYTES), name=f"{MANIFEST} in {store.name}")


def write_archive(store: Store, path: Path) -> int:
    """Write the bytes that the file sink would have written, and return how many frames they hold.

    The SHA-256 of every file is verified on the way; an existing file at ``path`` is replaced only by a whole archive.
    A run that has not ended gives a file without an index, which may be continued with ``--resume``.

    Raises:
        StreamError: frames have left the window, or a file is missing or damaged.
        StorageError: the file cannot be written.
    """
    stored = StoredBytes(store, read_manifest(store), check=True)
    if stored.gone:
        gone = " and ".join(f"{frames.start} to {frames.stop - 1}" for frames in stored.gone)
        raise StreamError(
            f"{store.name} is not whole: frames {gone} have left its window (--window). A stream file has no gaps; "
            "reconstruct without a window to archive a whole stream."
        )
    atomic_write(path, stored.files())
    return len(stored.sizes)


def _evenly(first: float, last: float, number: int) -> list[float]:
    """``number`` times from ``first`` to ``last``: those of numpy's ``linspace``, which the server runs without."""
    step = (last - first) / max(number - 1, 1)
    return [first + index * step for index in range(number - 1)] + [last if number > 1 else first]
