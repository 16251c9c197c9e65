# SPDX-License-Identifier: Apache-2.0
"""Writing a segment stops anywhere and goes on to the same bytes; what is there of another group is not taken."""

from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from structgstream.atomic_files import partial_path
from structgstream.codec.container import byte_source
from structgstream.codec.packets import PacketKind
from structgstream.errors import ConfigError, StorageError
from structgstream.groups import segment_file as segment_sink
from structgstream.groups.segment_file import GroupSoFar, SegmentSink, open_segment, resume_segment
from tests.support.killed import folders_of_the_killed
from tests.support.properties import examples
from tests.support.small_segments import END, FIRST, FROM_FRAME_0, IDENTITY, base, encoded, write
from tests.support.streams import same

COUNT = END - FIRST


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """The bytes of a finished segment."""
    return write(tmp_path_factory.mktemp("whole") / "g.sgs", encoded()[0]).read_bytes()


def go_on(path: Path) -> int:
    """Writes what is missing of a segment; returns how many packets that were."""
    found = resume_segment(path, base(), IDENTITY)
    if found is not None and found.complete:
        return 0
    done = 0 if found is None else len(found.entries)
    sink = SegmentSink(path, base(), IDENTITY, found)
    for packet in encoded()[0][done:]:
        sink.write(packet)
    sink.close()
    return COUNT - done


def test_a_segment_has_its_name_when_it_is_whole(tmp_path: Path) -> None:
    path = tmp_path / "g.sgs"
    for number in range(COUNT):
        write(path, encoded()[0][:number])
        assert not path.exists()
        assert len(open_segment(partial_path(path)).entries) == number
    write(path, encoded()[0])
    assert open_segment(path).complete
    assert not partial_path(path).exists()


def test_killed_at_any_step_it_goes_on_to_the_same_bytes_under_its_name(tmp_path: Path, whole: bytes) -> None:
    packets = encoded()[0]
    killed = folders_of_the_killed(tmp_path, lambda folder: write(folder / "g", packets), begin=lambda folder: None)
    assert len(killed) > COUNT
    for folder in killed:
        go_on(folder / "g")
        assert [(path.name, path.read_bytes()) for path in folder.iterdir()] == [("g", whole)]


def test_each_write_says_what_it_took(tmp_path: Path) -> None:
    path = tmp_path / "g.sgs"
    sink = SegmentSink(path, base(), IDENTITY, None)
    assert sink.open(base().header) == 0
    before = partial_path(path).stat().st_size
    took = [sink.write(packet) for packet in encoded()[0]]
    assert partial_path(path).stat().st_size - before == sum(took)
    sink.close()
    sink.close()
    assert open_segment(path).complete


def test_the_segment_of_frame_0_begins_with_it(tmp_path: Path) -> None:
    path = write(tmp_path / "g.sgs", encoded(1, FIRST)[0], identity=FROM_FRAME_0)
    found = open_segment(path)
    assert (found.complete, found.record(0)) == (True, base().first)


@examples(80)
@given(st.data())
def test_cut_and_flipped_anywhere_it_goes_on_to_the_same_bytes(
    whole: bytes, tmp_path_factory: pytest.TempPathFactory, choice: st.DataObject
) -> None:
    path = tmp_path_factory.mktemp("damaged") / "g.sgs"
    data = bytearray(whole[: choice.draw(st.integers(0, len(whole)))])
    if data and choice.draw(st.booleans()):
        data[choice.draw(st.integers(0, len(data) - 1))] ^= 1 << choice.draw(st.integers(0, 7))
    finished = choice.draw(st.booleans())
    (path if finished else partial_path(path)).write_bytes(data)
    go_on(path)
    assert path.read_bytes() == whole
    assert not partial_path(path).exists()


def test_a_finished_segment_is_left(tmp_path: Path, whole: bytes) -> None:
    path = tmp_path / "g.sgs"
    path.write_bytes(whole)
    before = path.stat()
    assert go_on(path) == 0
    assert (path.stat().st_mtime_ns, path.stat().st_ino) == (before.st_mtime_ns, before.st_ino)


def test_the_same_note_after_other_bytes_of_the_header_counts_as_nothing(tmp_path: Path, whole: bytes) -> None:
    path = tmp_path / "g.sgs"
    path.write_bytes(whole[:10] + bytes([1]) + whole[11:])  # Another minor version.
    assert resume_segment(path, base(), IDENTITY) is None


@pytest.mark.parametrize("finished", [False, True])
@pytest.mark.parametrize(
    ("other", "names"),
    [
        (replace(IDENTITY, track="another"), "track"),
        (replace(IDENTITY, first=FIRST - 1, capture="another"), "capture and first"),
        (replace(IDENTITY, options={"iterations": 7, "births": 50}), "options"),
    ],
)
def test_another_group_is_refused_and_kept(
    tmp_path: Path, whole: bytes, other: segment_sink.SegmentIdentity, names: str, *, finished: bool
) -> None:
    path = tmp_path / "g.sgs"
    there = path if finished else partial_path(path)
    there.write_bytes(whole if finished else whole[:-30])
    message = rf"is a group of another {names}; give the same header, track, capture and options"
    with pytest.raises(ConfigError, match=message):
        resume_segment(path, base(), other)
    assert there.read_bytes() == (whole if finished else whole[:-30])


def test_a_stream_of_this_name_is_refused_and_kept(tmp_path: Path) -> None:
    path, stream = tmp_path / "header.sgs", base().init + base().first
    path.write_bytes(stream)
    with pytest.raises(ConfigError, match=r"header\.sgs is a stream, not a segment of one; choose another name"):
        resume_segment(path, base(), IDENTITY)
    assert {each.name: each.read_bytes() for each in tmp_path.iterdir()} == {path.name: stream}


def test_a_nearly_full_disk_keeps_the_packets_before(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "g.sgs"
    sink = SegmentSink(path, base(), IDENTITY, None)
    sink.write(encoded()[0][0])
    monkeypatch.setattr(segment_sink, "free_bytes", lambda where: 10)
    assert byte_source.check_room is segment_sink.check_room
    with pytest.raises(StorageError, match=r"g\.sgs\.partial"):
        sink.write(encoded()[0][1])
    sink.close()
    assert len(open_segment(partial_path(path)).entries) == 1


def so_far(count: int) -> GroupSoFar:
    with_records = []
    for packet in encoded()[0][:count]:
        kind = segment_sink.RECORD_TYPES[packet.kind]
        with_records.append(segment_sink.packed(kind, packet.payload))
    return GroupSoFar(base(), FIRST, with_records)


def test_a_session_sees_a_stream_that_has_come_to_the_group() -> None:
    found = so_far(3)
    assert (len(found), found.complete, found.header) == (FIRST + 3, False, base().header)
    assert found.header_of(FIRST) is base().header
    assert [(info.index, info.kind) for info in found.packets] == [
        (FIRST, PacketKind.KEY),
        (FIRST + 1, PacketKind.DELTA),
        (FIRST + 2, PacketKind.KEY),
    ]
    assert [info.bytes for info in found.packets] == [len(record) for record in found.records]
    assert len(so_far(0)) == FIRST
    period = found.period(5)
    assert (period.number, period.offset + period.bytes) == (0, len(base().init))


def test_frames_are_those_that_the_encoder_saw() -> None:
    found = so_far(4)
    for number, scene in enumerate(encoded()[1]):
        assert same(found.scene(FIRST + number), scene)
    assert same(found.scene(FIRST - 1), base().scene())
