# SPDX-License-Identifier: Apache-2.0
"""The sound of a stream: Opus packets of 20 ms beside each frame (docs/bitstream.md, section Sound)."""

import math
import struct
from dataclasses import dataclass
from typing import Any

from structgstream.errors import StreamError

SAMPLE_RATE = 48_000
"""Of what decoding gives, in hertz."""
PACKET_SAMPLES = 960
"""Of each packet and channel: 20 ms."""
PACKET_SECONDS = PACKET_SAMPLES / SAMPLE_RATE
PREROLL_PACKETS = 8
"""Decoded before the first packet that is heard, where decoding begins within the sound; RFC 7845 asks for four."""
MAX_PACKET_BYTES = 1275
_HEAD = struct.Struct("<IdH")  # frame, seconds, number of packets
_CODEC = "opus"


@dataclass(frozen=True)
class SoundFormat:
    """What the init record states of the sound."""

    channels: int  # 1 or 2

    def plain(self) -> dict[str, object]:
        """As JSON has it."""
        return {"codec": _CODEC, "channels": self.channels}


def sound_format(value: Any) -> SoundFormat | None:
    """The sound that a description states; None if there is none, or of a codec that this version does not know.

    Raises:
        ValueError: it contradicts the format.
    """
    if value is None:
        return None
    if not isinstance(value, dict) or not isinstance(value.get("codec"), str):
        raise ValueError("sound must be an object with a codec")
    if value["codec"] != _CODEC:
        return None
    if type(channels := value.get("channels")) is not int or channels not in (1, 2):
        raise ValueError(f"sound has {channels!r} channels; it must be 1 or 2")
    return SoundFormat(channels)


@dataclass(frozen=True)
class FrameSound:
    """The sound that is stored with a frame: what begins before the frame ends and is not stored with earlier ones.

    Args:
        index: the frame.
        seconds: presentation time of the first sample that decoding the first packet gives.
        packets: of 20 ms each, one after the other.
    """

    index: int
    seconds: float
    packets: tuple[bytes, ...]

    def pack(self) -> bytes:
        """The payload of a sound record."""
        lengths = struct.pack(f"<{len(self.packets)}H", *map(len, self.packets))
        return _HEAD.pack(self.index, self.seconds, len(self.packets)) + lengths + b"".join(self.packets)


def unpack_sound(payload: bytes) -> FrameSound:
    """The sound in a sound record.

    Raises:
        StreamError: the payload violates the format.
    """
    if len(payload) < _HEAD.size:
        raise StreamError("A sound record is too short to hold its frame and time.")
    index, seconds, count = _HEAD.unpack_from(payload)
    start = _HEAD.size + 2 * count
    if not math.isfinite(seconds) or start > len(payload):
        raise StreamError(f"The sound record of frame {index} does not follow the format.")
    packets = []
    for length in struct.unpack_from(f"<{count}H", payload, _HEAD.size):
        packets.append(payload[start : start + length])
        start += length
    if start != len(payload) or not all(map(is_packet, packets)):
        raise StreamError(f"The sound record of frame {index} holds something else than Opus packets of 20 ms.")
    return FrameSound(index, seconds, tuple(packets))


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
