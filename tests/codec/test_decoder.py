# SPDX-License-Identifier: Apache-2.0
import struct
from dataclasses import replace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from structgstream.codec.container.blocks import pack_raw_block
from structgstream.codec.decoder import SceneDecoder
from structgstream.codec.encoder import SceneEncoder
from structgstream.codec.packets import Packet, PacketKind, parse_packet
from structgstream.errors import StreamError
from structgstream.scene.state import PAPER_DYNAMIC, STATE_TABLE, state_of
from tests.support.properties import examples
from tests.support.streams import header_for, small_scene

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
