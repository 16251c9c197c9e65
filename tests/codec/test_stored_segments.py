# SPDX-License-Identifier: Apache-2.0
"""The existing frames of a stream of segments, and the sink that continues it."""

import math
import os
from pathlib import Path

import pytest

from structgstream.codec.contents import LOST
from structgstream.codec.packets import PacketKind
from structgstream.codec.reader import StreamReader
from structgstream.codec.segments.sink import SegmentsOptions
from structgstream.codec.sinks import StoredSegments, resume_segments
from tests.support.segment_streams import as_file, folder, header, packets, written
from tests.support.streams import same

SENT = packets(9)


def stopped(path: Path, frames: int, *, options: SegmentsOptions | None = None) -> StoredSegments:
    written(folder(path), SENT[:frames], options=options)
    found = resume_segments(folder(path))[1]
    assert found is not None
    return found


def test_the_frames_are_those_of_the_file(tmp_path: Path) -> None:
    found = stopped(tmp_path, 8)
    with StreamReader(as_file(SENT[:8])) as whole:
        assert (len(found), found.complete) == (8, True)
        assert found.header.metadata == header().metadata
        for index in range(8):
            one, other = found.packets[index], whole.packets[index]
            assert (one.kind, one.index, one.pts_seconds, one.bytes) == (
                other.kind, other.index, other.pts_seconds, other.bytes,
            )  # fmt: skip
            assert same(found.scene(index), whole.scene(index))
            assert list(found.group(index)) == [SENT[index]]  # with codec raw nothing else is needed


def test_of_frames_that_have_left_the_window_size_and_kind_are_known(tmp_path: Path) -> None:
    found = stopped(tmp_path, 9, options=SegmentsOptions(window_seconds=0.01, grace_seconds=0.0))
    with StreamReader(as_file(SENT)) as whole:
        gone = [info for info in found.packets if info.offset == LOST]
        assert [info.index for info in gone] == [3, 4, 5]
        assert [info.kind for info in gone] == [PacketKind.KEY, PacketKind.DELTA, PacketKind.DELTA]
        assert [info.bytes for info in found.packets] == [info.bytes for info in whole.packets]
        assert all(math.isnan(info.pts_seconds) for info in gone)
        assert same(found.scene(8), whole.scene(8))


def test_a_sink_that_goes_on_changes_nothing_before_it_is_opened(tmp_path: Path) -> None:
    written(folder(tmp_path), SENT[:4])
    before = {name: (tmp_path / name).read_bytes() for name in os.listdir(tmp_path) if not name.startswith(".")}
    sink, found = resume_segments(folder(tmp_path))
    assert found is not None
    assert {name: (tmp_path / name).read_bytes() for name in before} == before
    sink.open(found.header)
    for packet in SENT[len(found) :]:
        sink.write(packet)
    sink.close()
    again = resume_segments(folder(tmp_path))[1]
    assert again is not None
    assert (len(again), again.complete) == (9, True)


def test_where_there_is_no_frame_the_stream_begins_again(tmp_path: Path) -> None:
    sink, found = resume_segments(folder(tmp_path))
    assert found is None
    sink.open(header())
    sink.write(SENT[0])
    sink.close()
    assert len(resume_segments(folder(tmp_path))[1] or pytest.fail("nothing")) == 1
