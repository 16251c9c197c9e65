# SPDX-License-Identifier: Apache-2.0
import struct
from dataclasses import replace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from structgstream.codec.container.blocks import pack_raw_block
from structgstream.codec.packets import Packet, PacketKind, pack_header, parse_packet, unpack_header
from structgstream.codec.scene_coder import SceneDecoder, SceneEncoder
from structgstream.errors import StreamError
from structgstream.scene.appearance import with_appearance
from structgstream.scene.state import PAPER_DYNAMIC, STATE_TABLE, state_of
from tests.support.properties import examples
from tests.support.rigs import random_scene
from tests.support.streams import header_for, moved, same, small_scene

NAMES = [row.name for row in STATE_TABLE]


@examples(25)
@given(
    st.integers(0, 12),
    st.integers(0, 6),
    st.integers(0, 1000),
    st.sets(st.sampled_from(NAMES)),
    st.sampled_from([1, 2]),
)
def test_decoding_gives_the_scene_back_bit_for_bit(anchors: int, free: int, seed: int, dynamic: set, kind: int) -> None:
    scene = with_appearance(random_scene(anchors, free=free, seed=seed, width=8), 3)
    scene = replace(scene, environment=torch.rand(9, 3))
    header = header_for(scene, dynamic=frozenset(dynamic))
    encoded = SceneEncoder(header).encode(scene, index=3, pts_seconds=0.1, kind=PacketKind(kind))
    receiver = SceneDecoder(unpack_header(pack_header(header)))
    packet = parse_packet(encoded.packet.payload, PacketKind(kind))
    assert packet == encoded.packet
    assert same(receiver.decode(packet), scene)
    assert same(encoded.reconstruction, scene)


def test_fields_come_in_the_order_of_the_table() -> None:
    encoded = SceneEncoder(header_for(small_scene())).encode(
        small_scene(), index=0, pts_seconds=0.0, kind=PacketKind.KEY
    )
    assert list(encoded.packet.field_bytes) == [name for name in NAMES if name in PAPER_DYNAMIC]
    assert sum(encoded.packet.field_bytes.values()) + 12 == len(encoded.packet.payload)


def test_the_reconstruction_has_the_header_s_static_fields() -> None:
    """Whatever a trainer does to them: the next frame starts from what a receiver has."""
    scene = small_scene()
    encoder = SceneEncoder(header_for(scene))
    changed = state_of(small_scene(seed=1))
    found = state_of(encoder.encode(small_scene(seed=1), index=0, pts_seconds=0.0, kind=PacketKind.KEY).reconstruction)
    for name, value in state_of(scene).items():
        assert torch.equal(found[name], changed[name] if name in PAPER_DYNAMIC else value), name


def test_the_reconstruction_shares_nothing_with_the_trainer() -> None:
    scene = moved(small_scene(), 1)
    encoded = SceneEncoder(header_for(scene)).encode(scene, index=0, pts_seconds=0.0, kind=PacketKind.KEY)
    before = encoded.reconstruction.anchors.positions.clone()
    scene.anchors.positions.add_(1.0)
    assert torch.equal(encoded.reconstruction.anchors.positions, before)


def test_another_number_of_anchors_than_the_header_s_is_refused() -> None:
    encoder = SceneEncoder(header_for(small_scene(3)))
    with pytest.raises(StreamError, match="Packet 1 has field"):
        encoder.encode(small_scene(4), index=1, pts_seconds=0.0, kind=PacketKind.DELTA)


@pytest.mark.parametrize("pts_seconds", [0.0, -1.0, float("nan"), float("inf")])
def test_time_rises(pts_seconds: float) -> None:
    """A reader would refuse the whole stream, so the encoder does first."""
    encoder = SceneEncoder(header_for(small_scene()))
    encoder.encode(small_scene(), index=0, pts_seconds=0.0, kind=PacketKind.KEY)
    with pytest.raises(StreamError, match="Frame 1 is to be presented at .* time stamps must rise"):
        encoder.encode(small_scene(), index=1, pts_seconds=pts_seconds, kind=PacketKind.DELTA)


SCENE = small_scene(3, free=2)
HEADER = header_for(SCENE)
PAYLOAD = SceneEncoder(HEADER).encode(SCENE, index=7, pts_seconds=0.25, kind=PacketKind.KEY).packet.payload


def test_another_codec_is_refused() -> None:
    with pytest.raises(StreamError, match="coded with 'tiny'; this version knows 'raw' and 'compact'. Install a newer"):
        SceneDecoder(replace(HEADER, codec="tiny"))


def test_fields_that_the_header_does_not_announce() -> None:
    state = state_of(SCENE)
    head = struct.pack("<Id", 0, 0.0)
    whole = [pack_raw_block(row.name, state[row.name]) for row in STATE_TABLE if row.name in PAPER_DYNAMIC]
    for blocks in (whole[1:], [*whole, pack_raw_block("anchor_offsets", state["anchor_offsets"])], []):
        packet = parse_packet(head + b"".join(blocks), PacketKind.KEY)
        with pytest.raises(StreamError, match="Packet 0 holds .*; the header announces anchor_positions, cov"):
            SceneDecoder(HEADER).decode(packet)


def test_a_packet_whose_sizes_contradict_the_header() -> None:
    state = {**state_of(SCENE), "free": torch.zeros(3, 14)}
    blocks = [pack_raw_block(row.name, state[row.name]) for row in STATE_TABLE if row.name in PAPER_DYNAMIC]
    packet = parse_packet(struct.pack("<Id", 0, 0.0) + b"".join(blocks), PacketKind.KEY)
    with pytest.raises(StreamError, match=r"field free_births as \(2,\) .* expected \(3\)"):
        SceneDecoder(HEADER).decode(packet)


@examples(200)
@given(st.integers(0, len(PAYLOAD) - 1), st.integers(1, 255), st.integers(0, len(PAYLOAD)))
def test_a_mangled_packet_gives_a_scene_or_one_kind_of_error(at: int, xor: int, end: int) -> None:
    """Mostly within heads and shapes, where it matters: the checksum is out of the way here."""
    mangled = bytearray(PAYLOAD)
    mangled[at] ^= xor
    for payload in (bytes(mangled), PAYLOAD[:end]):
        try:
            packet = parse_packet(payload, PacketKind.KEY)
            assert isinstance(packet, Packet)
            scene = SceneDecoder(HEADER).decode(packet)
        except StreamError:
            continue
        assert len(scene.anchors) == 3
