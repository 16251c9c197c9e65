# SPDX-License-Identifier: Apache-2.0
"""What is whole of a segment is read, and nothing else: cuts, flipped bits, notes that are none."""

import json
from dataclasses import asdict
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from hypothesis import given
from hypothesis import strategies as st

from structgstream.codec.container.records import PREFIX, packed
from structgstream.errors import StreamError
from structgstream.groups.segment_file import (
    FORMAT,
    NOTE,
    VERSION,
    Segment,
    SegmentIdentity,
    open_segment,
)
from tests.support.properties import examples
from tests.support.small_segments import END, FIRST, IDENTITY, base, encoded, write
from tests.support.streams import small_stream

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
    with pytest.raises(StreamError, match="is a stream, not a segment of one; expected what structgstream fit-group"):
        opened(tmp_path, small_stream(2))
    with pytest.raises(StreamError, match=r"g\.sgs is damaged before its first frame: "):
        opened(tmp_path, base().init)
    with pytest.raises(StreamError, match=r"g\.sgs is damaged before its first frame: "):
        opened(tmp_path, base().init[: PREFIX.size] + packed(NOTE, b"{}") * 2)
    with pytest.raises(StreamError, match=r"g\.sgs is cut at byte 0"):
        opened(tmp_path, b"")
    with pytest.raises(StreamError, match="is not a structgstream file"):
        opened(tmp_path, b"A letter to someone.")
    with pytest.raises(StreamError, match=r"Cannot read .*missing"):
        open_segment(tmp_path / "missing")
