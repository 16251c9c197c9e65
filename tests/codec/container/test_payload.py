# SPDX-License-Identifier: Apache-2.0
import math
import struct

import pytest
import torch

from structgstream.codec.container.blocks import pack_raw_block
from structgstream.codec.packets import PacketKind, packet_from_blocks, parse_packet
from structgstream.errors import StreamError
from structgstream.scene.state import FieldName

BLOCKS: dict[FieldName, bytes] = {
    "anchor_positions": pack_raw_block("anchor_positions", torch.zeros(2, 3)),
    "covariance_mlp": pack_raw_block("covariance_mlp", torch.ones(5)),
}


def test_what_is_packed_comes_back() -> None:
    packet = packet_from_blocks(BLOCKS, index=7, pts_seconds=0.25, kind=PacketKind.DELTA)
    assert parse_packet(packet.payload, PacketKind.DELTA) == packet
    assert (packet.kind, packet.index, packet.pts_seconds) == (PacketKind.DELTA, 7, 0.25)
    assert packet.field_bytes == {"anchor_positions": 4 + 8 + 24, "covariance_mlp": 4 + 4 + 20}
    assert packet.payload == struct.pack("<Id", 7, 0.25) + b"".join(BLOCKS.values())


@pytest.mark.parametrize("seconds", [math.nan, math.inf])
def test_a_time_that_is_none(seconds: float) -> None:
    with pytest.raises(StreamError, match="Packet 3 has the presentation time .*; it is damaged"):
        parse_packet(struct.pack("<Id", 3, seconds), PacketKind.KEY)


def test_a_payload_that_is_cut() -> None:
    payload = packet_from_blocks(BLOCKS, index=0, pts_seconds=0.0, kind=PacketKind.KEY).payload
    with pytest.raises(StreamError, match="too short to hold its index and time"):
        parse_packet(payload[:11], PacketKind.KEY)
    with pytest.raises(StreamError, match="Packet 0 "):
        parse_packet(payload[:-1], PacketKind.KEY)


def test_a_stream_that_is_as_long_as_it_can_be() -> None:
    """Identities of births are frame * 2^32 + number, of 63 bits: 2.27 years at 30 frames a second."""
    assert packet_from_blocks(BLOCKS, index=2**31 - 1, pts_seconds=7e7, kind=PacketKind.KEY).index == 2**31 - 1
    assert ((2**31 - 1) << 32) + 2**32 - 1 < 2**63
    assert 2.26 < 2**31 / 30 / 86400 / 365.25 < 2.28
    with pytest.raises(StreamError, match="A stream has at most 2147483648 frames; begin another one"):
        packet_from_blocks(BLOCKS, index=2**31, pts_seconds=7e7, kind=PacketKind.KEY)
