# SPDX-License-Identifier: Apache-2.0
"""A packet to a scene: everything a receiver needs besides a renderer."""

import math
import struct

from torch import Tensor

from structgstream.codec.blocks import blocks_in, unpacked_blocks
from structgstream.codec.packets import Packet, PacketKind, StreamHeader
from structgstream.codec.shapes import check_shapes
from structgstream.errors import StreamError
from structgstream.scene.scene import Scene
from structgstream.scene.state import FieldName, scene_of

FRAME = struct.Struct("<Id")  # index, presentation time in seconds


def packet_of(payload: bytes, kind: PacketKind) -> Packet:
    """The packet in a key or delta record.

    Raises:
        StreamError: the payload contradicts the format.
    """
    if len(payload) < FRAME.size:
        raise StreamError("A packet is too short to hold its index and time.")
    index, pts_seconds = FRAME.unpack_from(payload)
    if not math.isfinite(pts_seconds):
        raise StreamError(f"Packet {index} has the presentation time {pts_seconds}, which is no time.")
    blocks = blocks_in(payload, FRAME.size, where=f"Packet {index}")
    return Packet(kind, index, pts_seconds, payload, {block.name: block.end - block.start for block in blocks})


class SceneDecoder:
    """Decodes the packets of one stream. With the ``raw`` codec every packet stands alone.

    Raises:
        StreamError: the stream has a codec that this version does not know.
    """

    def __init__(self, header: StreamHeader) -> None:
        if header.codec != "raw":
            raise StreamError(
                f"The stream is coded with {header.codec!r}; this version knows 'raw'. Install a newer structgstream."
            )
        self._header = header

    def decode(self, packet: Packet) -> Scene:
        """The scene of one frame, on the CPU, in normalised units.

        Raises:
            StreamError: the packet's fields are not the header's dynamic ones, or their shapes contradict each other.
        """
        header, where = self._header, f"Packet {packet.index}"
        dynamic = unpacked_blocks(packet.payload, FRAME.size, where=where)
        if dynamic.keys() != header.dynamic:
            raise StreamError(
                f"{where} holds {', '.join(sorted(dynamic)) or 'no field'}; "
                f"the header announces {', '.join(sorted(header.dynamic)) or 'none'}."
            )
        fields: dict[FieldName, Tensor] = {**header.static, **dynamic}
        check_shapes(
            fields, distance_input=header.distance_input, training_cameras=len(header.rig.training), where=where
        )
        return scene_of(fields, distance_input=header.distance_input)
