# SPDX-License-Identifier: Apache-2.0
import json
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
import zstandard

from structgstream.codec.container.blocks import MAX_JSON_BYTES, pack_raw_block
from structgstream.codec.packets import (
    Packet,
    PacketKind,
    PacketSink,
    check_picture_sizes,
    pack_header,
    packet_from_blocks,
    unpack_header,
)
from structgstream.codec.sinks import FileSink, MemorySink
from structgstream.errors import CalibrationError, StreamError
from structgstream.scene.state import STATE_TABLE
from tests.support.streams import compact_header, header_for, small_scene


def test_both_sinks_take_packets(tmp_path: Path) -> None:
    sinks: list[PacketSink] = [MemorySink(), FileSink(tmp_path / "a.sgs")]
    for sink in sinks:
        sink.close()  # Nothing was opened, nothing happens.
    assert not (tmp_path / "a.sgs").exists()


def test_a_packet_is_shown_in_one_short_line() -> None:
    assert repr(Packet(PacketKind.DELTA, 3, 0.1, bytes(1000), {})) == "Packet(DELTA, index=3, 1000 bytes)"


def opened(payload: bytes) -> tuple[dict[str, Any], bytes]:
    """The description of an init record, and its blocks."""
    (length,) = struct.unpack_from("<I", payload)
    return json.loads(zstandard.ZstdDecompressor().decompress(payload[4 : 4 + length])), payload[4 + length :]


def closed(text: bytes, blocks: bytes) -> bytes:
    packed = zstandard.ZstdCompressor().compress(text)
    return struct.pack("<I", len(packed)) + packed + blocks


def edited(edit: Callable[[dict[str, Any]], object]) -> bytes:
    description, blocks = opened(pack_header(header_for(small_scene())))
    edit(description)
    return closed(json.dumps(description).encode(), blocks)


def test_a_header_comes_back() -> None:
    header = header_for(small_scene(7))
    header = replace(header, config={"a": {"b": [1, 0.1, None, "ä"]}}, metadata={"capture": "c", "n": 1})
    back = unpack_header(pack_header(header))
    assert (back.similarity, back.fps, back.codec, back.dynamic) == (
        header.similarity,
        header.fps,
        header.codec,
        header.dynamic,
    )
    assert (back.distance_input, back.config, back.metadata) == (True, header.config, header.metadata)
    assert [*back.rig] == [*header.rig]
    assert back.rig.held_out == {"cam00"}
    for name in header.rig:
        assert torch.equal(back.rig[name].viewmat, header.rig[name].viewmat)
        assert torch.equal(back.rig[name].K, header.rig[name].K)
        assert (back.rig[name].width, back.rig[name].height, back.rig[name].near) == (48, 32, 0.1)
    assert back.static.keys() == header.static.keys()
    assert all(torch.equal(back.static[name], value) for name, value in header.static.items())
    assert pack_header(back) == pack_header(header)


@pytest.mark.parametrize("dynamic", [frozenset(), frozenset(row.name for row in STATE_TABLE)])
def test_any_set_of_dynamic_fields(dynamic: frozenset) -> None:
    header = header_for(small_scene(2, free=1), dynamic=dynamic)
    assert unpack_header(pack_header(header)).dynamic == dynamic


EDITS: dict[str, Callable[[dict[str, Any]], object]] = {
    "'fps'": lambda d: d.pop("fps"),
    "0 where a positive": lambda d: d.update(fps=0),
    "Infinity is no number of JSON": lambda d: d.update(fps=float("inf")),
    "NaN is no number of JSON": lambda d: d["cameras"][0]["viewmat"].__setitem__(3, float("nan")),
    "True where a finite": lambda d: d["similarity"]["center"].__setitem__(0, True),
    "'1' where a finite": lambda d: d["similarity"].update(scale="1"),
    "too many values": lambda d: d["similarity"]["center"].append(0),
    "invalid for input": lambda d: d["cameras"][0]["K"].pop(),
    "each side must be 1 to 65535": lambda d: d["cameras"][0].update(width=2**31),
    "pixels of a picture must be at most 67108864": lambda d: d["cameras"][0].update(width=8192, height=8193),
    "48.0x32": lambda d: d["cameras"][0].update(width=48.0),
    "used once": lambda d: d["cameras"].append(d["cameras"][0]),
    "camera names": lambda d: d["cameras"][0].update(name=5),
    "at least two training": lambda d: d.update(cameras=d["cameras"][:2]),
    "not orthonormal": lambda d: d["cameras"][0]["viewmat"].__setitem__(0, 2.0),
    "must be objects": lambda d: d.update(config=[]),
    "true or false": lambda d: d.update(distance_input=1),
    "fields that packets do not carry": lambda d: d["dynamic"].pop(),
    "exactly the fields": lambda d: d["dynamic"].append("anchor_offsets"),
    "field 'tentacles' in packets, which this version does not know": lambda d: d["dynamic"].append("tentacles"),
    "coded with 'tiny'; this version knows": lambda d: d.update(codec="tiny", dynamic=[]),
    "unhashable": lambda d: d.update(dynamic=[[]]),
    r"field camera_color as \(2, 6\)": lambda d: d["cameras"][0].update(held_out=False),
    "hidden layer": lambda d: d.update(distance_input=False),
}


@pytest.mark.parametrize("message", EDITS)
def test_descriptions_that_break_the_format(message: str) -> None:
    with pytest.raises(StreamError, match=message):
        unpack_header(edited(EDITS[message]))


@pytest.mark.parametrize(("codec", "message"), [("tiny", "coded with 'tiny'"), ("raw", "codec 'raw' has no coding")])
def test_coded_fields_of_another_codec(codec: str, message: str) -> None:
    description, blocks = opened(pack_header(compact_header(small_scene())))
    with pytest.raises(StreamError, match=message):
        unpack_header(closed(json.dumps({**description, "codec": codec}).encode(), blocks))


def test_static_fields_that_do_not_fit_each_other() -> None:
    description, _ = opened(pack_header(header_for(small_scene(3))))
    other = header_for(small_scene(4)).static
    mixed = {**header_for(small_scene(3)).static, "anchor_features": other["anchor_features"]}
    blocks = b"".join(pack_raw_block(row.name, mixed[row.name]) for row in STATE_TABLE if row.name in mixed)
    with pytest.raises(StreamError, match=r"field anchor_features as \(4, 2\) .* expected \(3, D\)"):
        unpack_header(closed(json.dumps(description).encode(), blocks))


@pytest.mark.parametrize("text", [b"", b"null", b"[1]", b"\xff", b"{", b"[" * 200_000, b'{"cameras":[3]}'])
def test_texts_that_are_no_description(text: bytes) -> None:
    with pytest.raises(StreamError, match="init record"):
        unpack_header(closed(text, b""))


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_a_description_that_is_not_plain_utf_8(encoding: str) -> None:
    description, blocks = opened(pack_header(header_for(small_scene())))
    with pytest.raises(StreamError, match="init record"):
        unpack_header(closed(json.dumps(description).encode(encoding), blocks))


def test_what_follows_the_description_in_its_block() -> None:
    description, blocks = opened(pack_header(header_for(small_scene())))
    packed = zstandard.ZstdCompressor().compress(json.dumps(description).encode())
    for more in (b"\0", zstandard.ZstdCompressor().compress(b"{}")):
        with pytest.raises(StreamError, match="init record"):
            unpack_header(struct.pack("<I", len(packed + more)) + packed + more + blocks)


def test_a_description_that_no_reader_would_unpack_is_not_written() -> None:
    long = replace(header_for(small_scene(1)), metadata={"note": "a" * MAX_JSON_BYTES})
    with pytest.raises(StreamError, match=f"at most {MAX_JSON_BYTES} are allowed; leave out metadata or cameras"):
        pack_header(long)


def test_a_description_that_unpacks_to_too_much_is_not_unpacked() -> None:
    bomb = zstandard.ZstdCompressor().compress(bytes(MAX_JSON_BYTES + 1))
    stream = zstandard.ZstdCompressor().compressobj()
    unstated = stream.compress(b"{}") + stream.flush()
    for packed, size in ((bomb, MAX_JSON_BYTES + 1), (unstated, -1)):
        with pytest.raises(StreamError, match=f"unpacks to {size} bytes"):
            unpack_header(struct.pack("<I", len(packed)) + packed)


def test_a_stream_that_is_as_long_as_it_can_be() -> None:
    """Identities of births are frame * 2^32 + number, of 63 bits: 2.27 years at 30 frames a second."""
    assert packet_from_blocks({}, index=2**31 - 1, pts_seconds=7e7, kind=PacketKind.KEY).index == 2**31 - 1
    with pytest.raises(StreamError, match="A stream has at most 2147483648 frames; begin another one"):
        packet_from_blocks({}, index=2**31, pts_seconds=7e7, kind=PacketKind.KEY)


def test_a_rig_that_no_reader_would_draw_is_refused_before_training() -> None:
    rig = header_for(small_scene(1)).rig
    name = next(iter(rig))
    large = replace(rig, cameras={**rig.cameras, name: replace(rig[name], width=65_535, height=65_535)})
    with pytest.raises(CalibrationError, match=f"camera '{name}' have 65535x65535 pixels.*--scale 0.5"):
        check_picture_sizes(large)
    check_picture_sizes(replace(rig, cameras={**rig.cameras, name: replace(rig[name], width=8192, height=8192)}))


@pytest.mark.parametrize("value", ["yes", 1, None])
def test_cameras_are_held_out_or_not(value: object) -> None:
    with pytest.raises(StreamError, match="held_out"):
        unpack_header(edited(lambda d: d["cameras"][0].update(held_out=value)))


def test_a_header_cut_anywhere() -> None:
    payload = pack_header(header_for(small_scene(1)))
    for cut in range(len(payload)):
        with pytest.raises(StreamError):
            unpack_header(payload[:cut])
