# SPDX-License-Identifier: Apache-2.0
"""Segments of several periods: the bytes of the file, whatever happens on the way, and only what is needed is kept.

Headers are raw: their content does not matter here, and coding them would take most of the time.
"""

from pathlib import Path

import pytest

from structgstream.codec.container.records import MINOR_WITH_PERIODS, PREFIX
from structgstream.codec.reader import StreamReader, open_stream
from structgstream.codec.segments.sink import SegmentsOptions
from structgstream.codec.segments.store import FolderStore, Store
from structgstream.codec.segments.stored_bytes import StoredBytes, read_manifest, write_archive
from structgstream.codec.sinks import resume_segments
from structgstream.errors import StreamError
from tests.support.period_streams import FIRSTS, FRAMES, period_of, period_packets, period_stream
from tests.support.segment_streams import Hands, Killed, KilledStore, folder, written
from tests.support.streams import same


def write(
    store: Store, *, stop: int = FRAMES, options: SegmentsOptions | None = None, hands: Hands | None = None
) -> None:
    """Write the stream up to before frame ``stop``, or what is missing of it."""
    headers, packets, _ = period_packets(codec="raw")
    written(store, packets[:stop], options=options, hands=hands, periods=dict(zip(FIRSTS, headers)))


def inits(store: FolderStore) -> list[str]:
    return sorted(name for name in store.names() if name.startswith("init-"))


def test_the_folder_is_the_file(tmp_path: Path) -> None:
    data, seen = period_stream(codec="raw")
    store = folder(tmp_path / "out")
    write(store)
    manifest = read_manifest(store)
    assert [(one.period, one.first_frame) for one in manifest.periods] == [*enumerate(FIRSTS)]
    assert [one.first_segment for one in manifest.periods] == [0, 2, 5]
    assert [one.period for one in manifest.segments] == [period_of(one.first_frame) for one in manifest.segments]
    for period in manifest.periods:
        assert PREFIX.unpack(store.get(period.file)[: PREFIX.size])[2] == MINOR_WITH_PERIODS
    assert write_archive(store, tmp_path / "out.sgs") == FRAMES
    assert (tmp_path / "out.sgs").read_bytes() == data
    with open_stream(tmp_path / "out") as reader:
        assert all(same(reader.scene(index), seen[index]) for index in (0, 4, 5, 3, 11, 8))
    stored = StoredBytes(store, manifest)
    assert all(stored[at : at + 700] == data[at : at + 700] for at in range(0, len(data), 311))


def test_what_is_there_can_be_read_after_every_frame(tmp_path: Path) -> None:
    _, seen = period_stream(codec="raw")
    for stop in range(1, FRAMES + 1):
        store = folder(tmp_path / f"{stop}")
        write(store, stop=stop)
        with open_stream(store.folder) as reader:
            assert len(reader) == stop
            assert same(reader.scene(stop - 1), seen[stop - 1])
            assert reader.complete
        write(store)
        write_archive(store, tmp_path / "whole.sgs")
        assert (tmp_path / "whole.sgs").read_bytes() == period_stream(codec="raw")[0]


def test_killed_at_any_operation_it_goes_on_to_the_same_bytes(tmp_path: Path) -> None:
    """Before every operation, which is after the one before it, and after the last."""
    data, seen = period_stream(codec="raw")
    counted = KilledStore(folder(tmp_path / "counted"), at=10**6, done=True)
    write(counted)
    last = len(counted.operations) - 1
    for at, done in (*((at, False) for at in range(last + 1)), (last, True)):
        store = folder(tmp_path / f"{at}-{done}")
        with pytest.raises(Killed):
            write(KilledStore(store, at=at, done=done))
        if "manifest.json" in store.names():
            reader = StreamReader(StoredBytes(store, read_manifest(store)))
            assert same(reader.scene(len(reader) - 1), seen[len(reader) - 1])
        write(store)
        write_archive(store, tmp_path / "out.sgs")
        assert (tmp_path / "out.sgs").read_bytes() == data, counted.operations[at]


def test_an_init_record_is_named_before_its_first_frame_is_written(tmp_path: Path) -> None:
    """So players fetch it in time, and whoever goes on knows of which period a frame is that no manifest names."""
    headers, packets, _ = period_packets(codec="raw")
    store = folder(tmp_path / "out")
    sink, _ = resume_segments(store)
    sink.open(headers[0])
    for packet in packets[:4]:
        sink.write(packet)
    sink.begin(headers[1])
    named = read_manifest(store)
    assert (named.edge.frame, named.periods[-1].first_frame, named.periods[-1].first_segment) == (3, 4, 2)
    with open_stream(store.folder) as reader:
        assert (len(reader), len(reader.periods)) == (4, 1)
    sink.close()
    assert [one.period for one in read_manifest(store).periods] == [0]


def test_what_is_in_its_time_of_grace_stops_no_reader_and_no_writer(tmp_path: Path) -> None:
    """Segments of a period whose init record is not named any more are still in the folder, and count as gone."""
    options, store = SegmentsOptions(window_seconds=0.5 / 30.0, grace_seconds=120.0), folder(tmp_path / "out")
    for stop in range(1, FRAMES + 1):
        write(store, stop=stop, options=options)
        with open_stream(store.folder) as reader:
            assert same(reader.scene(stop - 1), period_stream(codec="raw")[1][stop - 1])
    assert [one.period for one in read_manifest(store).periods] == [2]
    with pytest.raises(StreamError, match="have left its window"):
        write_archive(store, tmp_path / "out.sgs")


@pytest.mark.parametrize("stops", [(), (4, 5, 9, 10)])
def test_with_a_window_what_nobody_needs_goes(tmp_path: Path, stops: tuple[int, ...]) -> None:
    """What stays of a period that has left the window is nothing; of the running one, its first segment."""
    options, hands = SegmentsOptions(window_seconds=0.5 / 30.0, grace_seconds=0.0), Hands()
    store = folder(tmp_path / "out")
    for stop in (*stops, FRAMES):
        write(store, stop=stop, options=options, hands=hands)
    manifest = read_manifest(store)
    assert [one.period for one in manifest.periods] == [2]
    assert len(inits(store)) == 1
    _, resumed = resume_segments(store, options=options)
    assert (len(resumed), resumed.period(FRAMES - 1).first_frame) == (FRAMES, 9)
    assert same(resumed.scene(FRAMES - 1), period_stream(codec="raw")[1][FRAMES - 1])
    assert same(resumed.scene(9), period_stream(codec="raw")[1][9])
    segments = sorted(name for name in store.names() if name.startswith("segment-"))
    assert [int(name.split("-")[1]) for name in segments] == [5, 6]
    assert [resumed.period(index).number for index in range(FRAMES)] == [period_of(index) for index in range(FRAMES)]
