# SPDX-License-Identifier: Apache-2.0
"""The sound of a stream: Opus packets of 20 ms beside each frame (docs/bitstream.md, section Sound)."""

import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from structgstream.errors import StreamError
from structgstream.opus import PACKET_SECONDS, OpusPacket, is_packet

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
    """The sound that a description states; None if there is none, or of a codec that this version does not know. Raises
    ValueError if it contradicts the format."""
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
    """The sound in a sound record. Raises StreamError if the payload violates the format."""
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


MAX_FRAME_PACKETS = 2**16 - 1
"""Packets of one record: 21 minutes."""


def frame_sound(index: int, pts_seconds: float, packets: Sequence[OpusPacket]) -> FrameSound:
    """The packets as a frame's sound. Before a gap, after which live sound begins again, nothing is stored.

    Args:
        pts_seconds: of the frame, for one without sound.
    """
    start = max(len(packets) - MAX_FRAME_PACKETS, 0)
    for place in range(start + 1, len(packets)):
        if abs(packets[place].seconds - packets[place - 1].seconds - PACKET_SECONDS) > PACKET_SECONDS / 2:
            start = place
    first = packets[start].seconds if packets else pts_seconds
    return FrameSound(index, first, tuple(packet.data for packet in packets[start:]))
