# SPDX-License-Identifier: Apache-2.0
"""What of a stream stays, one manifest after the other (``test_sink`` has it with a sink and its files)."""

from dataclasses import replace
from pathlib import Path

import pytest

from structgstream.codec.segments.manifest import Manifest, PeriodEntry, SegmentEntry, Window
from structgstream.codec.segments.recovery import empty_manifest
from structgstream.codec.segments.sink import Retention, SegmentsOptions
from structgstream.codec.segments.store import FolderStore
from tests.support.segment_streams import SHA256, folder, header, segment_entry

FIRST = PeriodEntry(0, "init-0000-0123456789abcdef.sgs", 10, SHA256, 0, 0)
SECOND = PeriodEntry(1, "init-0001-0123456789abcdef.sgs", 10, SHA256, 12, 4)


def segment(number: int) -> SegmentEntry:
    """Three frames, a second apart."""
    return segment_entry(number, fps=1.0)


def manifest(segments: int, *, periods: tuple[PeriodEntry, ...] = (FIRST,), after: Manifest | None = None) -> Manifest:
    """After so many segments, and with the window of the manifest before."""
    found = empty_manifest(header(), FIRST)
    found = found if after is None else replace(found, window=after.window)
    last = 3 * segments - 1
    edge = replace(found.edge, frame=last, pts_seconds=float(last))
    return replace(found, edge=edge, periods=periods, segments=tuple(map(segment, range(segments))))


@pytest.fixture
def store(tmp_path: Path) -> FolderStore:
    found = folder(tmp_path)
    for number in range(8):
        found.put(segment(number).file, b"")
    return found


def there(store: FolderStore) -> list[int]:
    """Numbers of the segments in a store."""
    return [number for number in range(8) if segment(number).file in store.names()]


def publish(retention: Retention, named: Manifest) -> Manifest:
    """The manifest with its window, once it is written."""
    named = replace(named, window=retention.window(named))
    retention.published(named)
    return named


def test_a_segment_leaves_the_window_at_once_and_the_store_after_the_time_of_grace(store: FolderStore) -> None:
    now = [0.0]
    retention = Retention(store, SegmentsOptions(window_seconds=4.0, grace_seconds=5.0), lambda: now[0])
    periods, last = (FIRST, SECOND), None
    for segments in range(1, 7):
        last = publish(retention, manifest(segments, periods=periods, after=last))
        first = max(segments - 2, 0)
        assert (last.window.first_segment, last.window.first_frame) == (first, 3 * first)
    assert there(store) == [*range(8)]
    now[0] = 5.0
    publish(retention, manifest(6, periods=periods, after=last))
    assert there(store) == [4, 5, 6, 7], "a period begins at segment 4, so that nothing needs segment 0"


def test_what_a_stream_that_is_taken_up_needed_goes_when_another_period_runs(store: FolderStore) -> None:
    options, last = SegmentsOptions(window_seconds=4.0, grace_seconds=0.0), None
    before = Retention(store, options, lambda: 0.0)
    for segments in range(1, 5):
        last = publish(before, manifest(segments, after=last))
    assert there(store) == [0, 2, 3, 4, 5, 6, 7]
    retention = Retention(store, options, lambda: 0.0)
    retention.take_up(last)
    last = publish(retention, manifest(4, after=last))
    assert there(store) == [0, 2, 3], "those after it were written too early"
    for segments in (5, 6):
        store.put(segment(segments - 1).file, b"")
        last = publish(retention, manifest(segments, periods=(FIRST, SECOND), after=last))
    assert there(store) == [4, 5]


def test_what_went_before_a_stream_is_taken_up_is_not_removed_again(
    store: FolderStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    last = manifest(8, after=replace(manifest(8), window=Window(15, 5, 4.0)))
    for number in range(1, 5):  # resuming needs the first one
        store.delete(segment(number).file)
    deleted: list[str] = []
    monkeypatch.setattr(store, "delete", deleted.append)
    now = [0.0]
    retention = Retention(store, SegmentsOptions(window_seconds=4.0, grace_seconds=5.0), lambda: now[0])
    retention.take_up(last)
    for now[0] in (1.0, 7.0, 14.0):
        last = publish(retention, last)
    assert last.window.first_segment == 6
    assert deleted == [segment(5).file]
