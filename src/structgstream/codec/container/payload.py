# SPDX-License-Identifier: Apache-2.0
"""The payload of a packet's record: frame index, presentation time, field blocks."""

import math
from collections.abc import Mapping

from structgstream.codec.container.blocks import iterate_blocks
from structgstream.codec.container.packet_head import FRAME
from structgstream.codec.packets import Packet, PacketKind
from structgstream.errors import StreamError
from structgstream.scene.state import FieldName

MAX_FRAMES = 2**31
"""Frames of a stream."""


def packet_from_blocks(
    blocks: Mapping[FieldName, bytes], *, index: int, pts_seconds: float, kind: PacketKind
) -> Packet:
    """The packet of a frame with these field blocks, in this order.

    Raises:
        StreamError: the stream is as long as it can be.
    """
    # The identity of a birth is frame * 2^32 + number, of 63 bits. 2^31 frames are 2.27 years at 30 frames a second.
    if index >= MAX_FRAMES:
        raise StreamError(f"A stream has at most {MAX_FRAMES} frames; begin another one.")
    payload = FRAME.pack(index, pts_seconds) + b"".join(blocks.values())
    return Packet(kind, index, pts_seconds, payload, {name: len(block) for name, block in blocks.items()})


def parse_packet(payload: bytes, kind: PacketKind) -> Packet:
    """The packet in a key or delta record.

    Raises:
        StreamError: the payload violates the format.
    """
    if len(payload) < FRAME.size:
        raise StreamError("A packet is too short to hold its index and time.")
    index, pts_seconds = FRAME.unpack_from(payload)
    if not math.isfinite(pts_seconds):
        raise StreamError(f"Packet {index} has the presentation time {pts_seconds}; it is damaged.")
    blocks = iterate_blocks(payload, FRAME.size, where=f"Packet {index}")
    return Packet(kind, index, pts_seconds, payload, {block.name: block.end - block.start for block in blocks})
