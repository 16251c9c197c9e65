# SPDX-License-Identifier: Apache-2.0
"""What is whole of a segment is read, and nothing else; writing stops anywhere and goes on to the same bytes."""

import json
from dataclasses import asdict, replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from hypothesis import given
from hypothesis import strategies as st

from structgstream.atomic_files import partial_path
from structgstream.codec.container import byte_source
from structgstream.codec.container.records import PREFIX, packed
from structgstream.codec.packets import PacketKind
from structgstream.errors import ConfigError, StorageError, StreamError
from structgstream.groups import segment_file as segment_sink
from structgstream.groups.segment_file import (
    FORMAT,
    NOTE,
    VERSION,
    GroupSoFar,
    Segment,
    SegmentIdentity,
    SegmentSink,
    open_segment,
    resume_segment,
)
from tests.support.killed import folders_of_the_killed
from tests.support.properties import examples
from tests.support.small_segments import END, FIRST, FROM_FRAME_0, IDENTITY, base, encoded, write
from tests.support.streams import same, small_stream

COUNT = END - FIRST


@cache
def whole() -> bytes:
    """The bytes of a finished segment."""
    with TemporaryDirectory() as folder:
        return write(Path(folder) / "g.sgs", encoded()[0]).read_bytes()


@cache
def entries() -> list[tuple[int, int, int]]:
    """Its packets: frame, type, offset."""
    with TemporaryDirectory() as folder:
        return opened(Path(folder), whole()).entries


@cache
def ends() -> list[int]:
    """Where each packet ends."""
    with TemporaryDirectory() as folder:
        return [*(offset for _, _, offset in entries()[1:]), opened(Path(folder), whole()).end]


def opened(folder: Path, data: bytes) -> Segment:
    path = folder / "g.sgs"
    path.write_bytes(data)
    return open_segment(path)


def test_a_finished_segment_is_read_whole(tmp_path: Path) -> None:
    path = tmp_path / "g.sgs"
    path.write_bytes(whole())
    found = open_segment(path)
    assert (found.identity, found.init, len(found.entries)) == (IDENTITY, base().init, END - FIRST)
    assert (found.complete, found.reason) == (True, None)
    assert [frame for frame, _, _ in found.entries] == [*range(FIRST, END)]
    for number, packet in enumerate(encoded()[0]):
        assert packet.payload in found.record(number)
    assert b"".join(map(found.record, range(COUNT))) == whole()[entries()[0][2] : found.end]


@examples(200)
@given(st.data())
def test_cut_anywhere_the_frames_before_are_there(choice: st.DataObject) -> None:
    length = choice.draw(st.integers(0, len(whole())))
    with TemporaryDirectory() as folder:
        try:
            found = opened(Path(folder), whole()[:length])
        except StreamError:
            assert length < entries()[0][2], "with the note whole it is a segment"
            return
    frames = sum(end <= length for end in ends())
    assert len(found.entries) == frames
    assert found.complete == (length == len(whole()))
    assert (found.reason is None) == found.complete
    assert found.end == (ends()[frames - 1] if frames else entries()[0][2])


@examples(400)
@given(st.data())
def test_a_flipped_bit_anywhere_is_never_a_whole_segment(choice: st.DataObject) -> None:
    byte = choice.draw(st.integers(0, len(whole()) - 1) | st.integers(0, 60))
    data = bytearray(whole())
    data[byte] ^= 1 << choice.draw(st.integers(0, 7))
    minor = PREFIX.size - 2 <= byte < PREFIX.size
    with TemporaryDirectory() as folder:
        try:
            found = opened(Path(folder), bytes(data))
        except StreamError:
            assert byte < entries()[0][2]
            return
    frames = sum(end <= byte for end in ends())
    if minor:  # Newer minor versions are read; what goes on or is joined compares the whole init with the header's.
        assert (found.complete, found.init == base().init) == (True, False)
        return
    assert byte >= entries()[0][2]
    assert (found.complete, len(found.entries)) == (False, frames)
    assert found.identity == IDENTITY


@pytest.mark.parametrize("more", [b"\0", b"more", packed(NOTE, b"{}")])
def test_what_follows_the_footer_is_damage(tmp_path: Path, more: bytes) -> None:
    found = opened(tmp_path, whole() + more)
    assert (found.complete, found.reason) == (False, "it has 4 of 4 frames; its index is damaged")


def test_packets_of_other_frames_are_not_those_of_the_group(tmp_path: Path) -> None:
    first, second, third = (offset for _, _, offset in entries()[:3])
    without = whole()[:second] + whole()[third:]
    assert len(opened(tmp_path, without).entries) == 1
    swapped = whole()[:first] + whole()[second:third] + whole()[first:second] + whole()[third:]
    assert not opened(tmp_path, swapped).entries


def noted(**change: object) -> bytes:
    """A note with other values, which keeps the hash that it states."""
    text = {"format": FORMAT, "version": VERSION, "sha256": IDENTITY.sha256, **asdict(IDENTITY), **change}
    return json.dumps({name: value for name, value in text.items() if value is not None}).encode()


def hashed(first: object, end: object) -> bytes:
    """A note whose hash is right, of frames that are none."""
    identity = SegmentIdentity("h", "c", "t", {}, first, end)  # type: ignore[arg-type]
    return json.dumps({"format": FORMAT, "version": VERSION, "sha256": identity.sha256, **asdict(identity)}).encode()


@pytest.mark.parametrize(
    ("note", "why"),
    [
        (b"", "Expecting value"),
        (b"\xff\xfe\xfd", "decode"),
        (b'"text"', "it is no object"),
        (b"[1]", "it is no object"),
        (b"[" * 100_000, "recursion"),
        (b"{}", "'format'"),
        (noted(format="another"), "another format or version"),
        (noted(version=2), "another format or version"),
        (noted(first=4), "contradicts itself"),
        (noted(track=None), "missing 1 required positional argument"),
        (noted(more=1), "unexpected keyword argument"),
        (hashed("3", "7"), "frames 3 to before 7"),
        (hashed(3, 3.5), "frames 3 to before 3.5"),
        (hashed(3, 3), "frames 3 to before 3"),
        (hashed(-1, 3), "frames -1 to before 3"),
    ],
)
def test_notes_that_are_none_are_reported(tmp_path: Path, note: bytes, why: str) -> None:
    with pytest.raises(StreamError, match=rf"The note of the segment .*g\.sgs does not follow the format \(.*{why}"):
        opened(tmp_path, base().init + packed(NOTE, note))


def test_what_is_no_segment_is_reported(tmp_path: Path) -> None:
    for data, said in (
        (small_stream(2), "is a stream, not a segment of one; expected what structgstream fit-group"),
        (base().init, r"g\.sgs is damaged before its first frame: "),
        (base().init[: PREFIX.size] + packed(NOTE, b"{}") * 2, r"g\.sgs is damaged before its first frame: "),
        (b"", r"g\.sgs is cut at byte 0"),
        (b"A letter to someone.", "is not a structgstream file"),
    ):
        with pytest.raises(StreamError, match=said):
            opened(tmp_path, data)
    with pytest.raises(StreamError, match=r"Cannot read .*missing"):
        open_segment(tmp_path / "missing")


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


def test_killed_at_any_step_it_goes_on_to_the_same_bytes_under_its_name(tmp_path: Path) -> None:
    packets = encoded()[0]
    killed = folders_of_the_killed(tmp_path, lambda folder: write(folder / "g", packets), begin=lambda folder: None)
    assert len(killed) > COUNT
    for folder in killed:
        go_on(folder / "g")
        assert [(path.name, path.read_bytes()) for path in folder.iterdir()] == [("g", whole())]


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
    tmp_path_factory: pytest.TempPathFactory, choice: st.DataObject
) -> None:
    path = tmp_path_factory.mktemp("damaged") / "g.sgs"
    data = bytearray(whole()[: choice.draw(st.integers(0, len(whole())))])
    if data and choice.draw(st.booleans()):
        data[choice.draw(st.integers(0, len(data) - 1))] ^= 1 << choice.draw(st.integers(0, 7))
    finished = choice.draw(st.booleans())
    (path if finished else partial_path(path)).write_bytes(data)
    go_on(path)
    assert path.read_bytes() == whole()
    assert not partial_path(path).exists()


def test_a_damaged_segment_that_cannot_be_renamed(tmp_path: Path) -> None:
    path = tmp_path / "g.sgs"
    path.write_bytes(whole()[:-30])
    (partial_path(path) / "full").mkdir(parents=True)
    with pytest.raises(StorageError, match="cannot be renamed"):
        resume_segment(path, base(), IDENTITY)
    assert path.read_bytes() == whole()[:-30]


def test_a_finished_segment_is_left(tmp_path: Path) -> None:
    path = tmp_path / "g.sgs"
    path.write_bytes(whole())
    before = path.stat()
    assert go_on(path) == 0
    assert (path.stat().st_mtime_ns, path.stat().st_ino) == (before.st_mtime_ns, before.st_ino)


def test_the_same_note_after_other_bytes_of_the_header_counts_as_nothing(tmp_path: Path) -> None:
    path = tmp_path / "g.sgs"
    path.write_bytes(whole()[:10] + bytes([1]) + whole()[11:])  # Another minor version.
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
    tmp_path: Path, other: segment_sink.SegmentIdentity, names: str, *, finished: bool
) -> None:
    path = tmp_path / "g.sgs"
    there = path if finished else partial_path(path)
    there.write_bytes(whole() if finished else whole()[:-30])
    message = rf"is a group of another {names}; give the same header, track, capture and options"
    with pytest.raises(ConfigError, match=message):
        resume_segment(path, base(), other)
    assert there.read_bytes() == (whole() if finished else whole()[:-30])


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
