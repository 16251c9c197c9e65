# SPDX-License-Identifier: Apache-2.0
"""Decodes packets to scenes."""

from collections.abc import Set

from torch import Tensor

from structgstream.codec.container.blocks import coded_payloads, unpack_raw_blocks
from structgstream.codec.container.packet_head import FRAME
from structgstream.codec.packets import Packet, StreamHeader
from structgstream.codec.scene.compact import CompactDecoder, CompactState
from structgstream.codec.scene.shapes import check_shapes
from structgstream.errors import StreamError
from structgstream.scene.sampling import RigSampling
from structgstream.scene.scene import Scene
from structgstream.scene.state import FieldName, scene_of


class SceneDecoder:
    """Decodes the packets of one stream, in order: a delta packet follows the packet before it.

    Key packets, and with the ``raw`` codec all packets, can be decoded without the one before.

    Raises:
        StreamError: the codec is unknown to this version, or the header is inconsistent with it.
    """

    def __init__(self, header: StreamHeader) -> None:
        self._header = header
        self._sampling = RigSampling.of(header.similarity.rig(header.rig))
        self._compact = None if header.codec == "raw" else CompactDecoder(header)

    @property
    def state(self) -> CompactState | None:
        """The ``compact`` codec's state after the last packet."""
        return None if self._compact is None else self._compact.state

    def decode(self, packet: Packet) -> Scene:
        """The scene of one frame, on the CPU, in normalised units.

        Raises:
            StreamError: the packet's fields are not the header's dynamic ones, their shapes are inconsistent, or the
                packet before it has not been decoded.
        """
        header, where = self._header, f"Packet {packet.index}"
        if self._compact is None:
            dynamic = unpack_raw_blocks(packet.payload, FRAME.size, where=where)
        else:
            coded = coded_payloads(packet.payload, FRAME.size, where=where)
            _check_fields(coded.keys(), header, where)
            dynamic = self._compact.decode(coded, kind=packet.kind, index=packet.index)
        _check_fields(dynamic.keys(), header, where)
        fields: dict[FieldName, Tensor] = {**header.static, **dynamic}
        check_shapes(
            fields, distance_input=header.distance_input, training_cameras=len(header.rig.training), where=where
        )
        return scene_of(fields, distance_input=header.distance_input, sampling=self._sampling)


def _check_fields(names: Set[FieldName], header: StreamHeader, where: str) -> None:
    if names != header.dynamic:
        raise StreamError(
            f"{where} holds {', '.join(sorted(names)) or 'no field'}; "
            f"the header announces {', '.join(sorted(header.dynamic)) or 'none'}."
        )
