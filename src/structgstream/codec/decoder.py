# SPDX-License-Identifier: Apache-2.0
"""A packet to a scene: everything a receiver needs besides a renderer."""

import struct

from structgstream.codec.blocks import unpacked_blocks
from structgstream.codec.packets import Packet, PacketKind, StreamHeader
from structgstream.errors import StreamError
from structgstream.scene.scene import Scene
from structgstream.scene.state import scene_of

_FRAME = struct.Struct("<Id")


def packet_of(payload: bytes, kind: PacketKind) -> Packet:
    """The packet in a key or delta record.

    Raises:
        StreamError: the payload contradicts the format.
    """
    if len(payload) < _FRAME.size:
        raise StreamError("A packet is too short to hold its index and time.")
    index, pts_seconds = _FRAME.unpack_from(payload)
    _, lengths = unpacked_blocks(payload, _FRAME.size, where=f"Packet {index}")
    return Packet(kind, index, pts_seconds, payload, lengths)


class SceneDecoder:
    """Decodes the packets of one stream. With the ``raw`` codec every packet stands alone."""

    def __init__(self, header: StreamHeader) -> None:
        if header.codec != "raw":
            raise StreamError(f"The stream is coded with {header.codec!r}; this version knows 'raw'.")
        self._header = header

    def decode(self, packet: Packet) -> Scene:
        """The scene of one frame, on the CPU, in normalised units.

        Raises:
            StreamError: a field is missing or has a shape that does not fit the others.
        """
        dynamic, _ = unpacked_blocks(packet.payload, _FRAME.size, where=f"Packet {packet.index}")
        missing = sorted(self._header.dynamic - set(dynamic))
        if missing:
            raise StreamError(f"Packet {packet.index} lacks {', '.join(missing)}.")
        try:
            return scene_of({**self._header.static, **dynamic}, distance_input=self._header.distance_input)
        except (RuntimeError, KeyError, IndexError) as error:
            raise StreamError(f"The fields of packet {packet.index} do not fit together ({error}).") from error
