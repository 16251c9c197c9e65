# SPDX-License-Identifier: Apache-2.0
"""Packets of Opus as streams hold them: 20 ms each (docs/bitstream.md, section Sound)."""

from dataclasses import dataclass

SAMPLE_RATE = 48_000
"""Of what decoding gives, in hertz."""
PACKET_SAMPLES = 960
"""Of each packet and channel: 20 ms."""
PACKET_SECONDS = PACKET_SAMPLES / SAMPLE_RATE
MAX_PACKET_BYTES = 1275


@dataclass(frozen=True)
class OpusPacket:
    """20 ms of sound."""

    seconds: float  # presentation time of the first sample that decoding gives
    data: bytes


def is_packet(packet: bytes) -> bool:
    """Whether this may be an Opus packet of 20 ms, by its first bytes (RFC 6716, section 3.1)."""
    if not 1 <= len(packet) <= MAX_PACKET_BYTES:
        return False
    config, code = packet[0] >> 3, packet[0] & 3
    if config < 12:
        frame = (10.0, 20.0, 40.0, 60.0)[config & 3]
    elif config < 16:
        frame = (10.0, 20.0)[config & 1]
    else:
        frame = (2.5, 5.0, 10.0, 20.0)[config & 3]
    if code < 3:
        return frame * (1 if code == 0 else 2) == 20.0
    return len(packet) > 1 and frame * (packet[1] & 63) == 20.0
