# SPDX-License-Identifier: Apache-2.0
"""The manifest of a stream that runs for weeks stays small, and every segment is found again."""

from pathlib import Path

import pytest

from structgstream.codec.packets import PacketKind
from structgstream.codec.segments.manifest import (
    Edge,
    HistoryEntry,
    Manifest,
    PartEntry,
    PeriodEntry,
    SegmentEntry,
    Window,
    file_name,
    manifest_from_json,
    manifest_to_json,
)
from structgstream.codec.segments.store import FolderStore
from structgstream.codec.segments.stored_bytes import paged, segments_from
from structgstream.errors import StreamError
from tests.support.segment_streams import SHA256, segment_entry


def grown(folder: Path, segments: int, frames: int) -> tuple[tuple[HistoryEntry, ...], tuple[SegmentEntry, ...], int]:
    """History and segments after as many groups, and the longest that both together were as JSON."""
    history: tuple[HistoryEntry, ...] = ()
    listed: tuple[SegmentEntry, ...] = ()
    longest = 0
    for number in range(segments):
        found = paged(history, (*listed, segment_entry(number, frames=frames, sizes=(123_456, 45_678))))
        for name, data in found.pages:
            (folder / name).write_bytes(data)
        history, listed = found.history, found.segments
        if number % 61 == 60:
            longest = max(longest, len(manifest_to_json(manifest(history, listed, frames))))
    return history, listed, longest


def manifest(history: tuple[HistoryEntry, ...], listed: tuple[SegmentEntry, ...], frames: int) -> Manifest:
    first = listed[-1].first_frame + frames
    parts = tuple(
        PartEntry(file_name("part", first + i, SHA256), first + i, 0, kind, (first + i) / 30, 45_678, SHA256)
        for i, kind in enumerate((PacketKind.KEY, *[PacketKind.DELTA] * (frames - 1)))
    )
    edge = Edge(first + frames - 1, parts[-1].pts_seconds, 1.7e9, 1.7e9)
    period = PeriodEntry(0, file_name("init", 0, SHA256), 800_000, SHA256, 0, 0)
    return Manifest(9, True, 30.0, "x", 2.0, 1.0, edge, Window(0, 0, None), (period,), history, listed, parts)


@pytest.mark.parametrize(("segments", "frames"), [(33_000, 3), (2_000, 90)])
def test_a_manifest_stays_below_50_kb_and_everything_is_found(tmp_path: Path, segments: int, frames: int) -> None:
    """After 33000 groups the third level is reached; long groups have long entries."""
    store = FolderStore(tmp_path)
    history, listed, longest = grown(tmp_path, segments, frames)
    assert longest < 50_000
    whole = manifest(history, listed, frames)
    assert manifest_from_json(manifest_to_json(whole), name="x") == whole
    assert max(entry.level for entry in history) == (2 if segments == 33_000 else 1)
    late = segments - 1_500
    assert [entry.segment for entry in segments_from(store, history, listed, first=late)] == [*range(late, segments)]
    assert next(segments_from(store, history, listed)).segment == 0
    assert all(path.stat().st_size < 50_000 for path in tmp_path.iterdir())


def test_a_page_that_was_changed_is_refused(tmp_path: Path) -> None:
    history, listed, _ = grown(tmp_path, 100, 3)
    page = tmp_path / history[0].file
    data = page.read_bytes()
    for changed, message in (
        (data.replace(b"45678", b"45679"), f"{page.name} in {tmp_path} is damaged"),
        (data + b" ", "the manifest states"),
    ):
        page.write_bytes(changed)
        with pytest.raises(StreamError, match=message):
            list(segments_from(FolderStore(tmp_path), history, listed))
