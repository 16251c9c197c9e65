# SPDX-License-Identifier: Apache-2.0
"""Encodes scenes to packets, with the decoder's reconstruction.

Note [Closed loop]
~~~~~~~~~~~~~~~~~~
Prediction is closed-loop: :meth:`SceneEncoder.encode` decodes the bytes it has just made and returns the
reconstruction, from which the trainer starts the next frame. It equals the decoder's scene bit for bit; otherwise
trainer and viewers would diverge.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Generic, TypeVar

from torch import Tensor

from structgstream.codec.container.blocks import pack_coded_block, pack_raw_block
from structgstream.codec.decoder import CompactCoder, CompactState, SceneDecoder
from structgstream.codec.entropy.adaptive import AdaptiveEncoder
from structgstream.codec.fields.packet_fields import quantize_state
from structgstream.codec.packets import Packet, PacketKind, StreamHeader, packet_from_blocks
from structgstream.errors import StreamError
from structgstream.scene.scene import Scene
from structgstream.scene.state import STATE_TABLE, FieldName, state_of

SceneT = TypeVar("SceneT", covariant=True)


@dataclass(frozen=True)
class Encoded(Generic[SceneT]):
    """A packet and its reconstruction: the scene that a decoder gets."""

    packet: Packet
    reconstruction: SceneT


class CompactEncoder(CompactCoder):
    """Encodes the frames of one stream, in order."""

    def replay(self, state: CompactState | None) -> None:
        """Continue from a decoder's state."""
        self.state = state

    def encode(self, state: Mapping[FieldName, Tensor], *, kind: PacketKind, index: int) -> dict[FieldName, bytes]:
        """The bytes of each dynamic field. Raises StreamError if a value is out of range, or a delta packet does not
        follow the packet before it."""
        before, models = self._start(kind, index)
        after = quantize_state(state, self._header.dynamic, self._header.steps)
        if after.anchors.shape != before.anchors.shape:
            raise StreamError(f"Frame {index} has {len(after.anchors)} anchors, the header {len(before.anchors)}.")
        for name, bins in after.weights.items():
            if bins.shape != before.weights[name].shape:
                raise StreamError(f"Frame {index} has {name} of another size than the header.")
        encoder = AdaptiveEncoder(models, where=f"Frame {index}")
        self._keep(kind, index, self._code(encoder, after, before, index), models)
        fields = encoder.fields()
        return {name: fields.get(name, b"") for name in self._header.dynamic}


class SceneEncoder:
    """Encodes scenes of one stream, in order."""

    def __init__(self, header: StreamHeader) -> None:
        self._header = header
        self._decoder = SceneDecoder(header)
        self._compact = None if header.codec == "raw" else CompactEncoder(header)
        self._last_pts_seconds = -math.inf

    def replay(self, packet: Packet) -> Scene:
        """Continue after ``packet`` of another encoder, and return its scene; call it for every packet of the group.
        Raises StreamError if it does not follow the packet before it, or is damaged."""
        scene = self._decoder.decode(packet)
        if self._compact is not None:
            self._compact.replay(self._decoder.state)
        self._last_pts_seconds = packet.pts_seconds
        return scene

    def encode(self, scene: Scene, *, index: int, pts_seconds: float, kind: PacketKind) -> Encoded[Scene]:
        """The packet of one frame. Raises StreamError if the scene's shapes differ from the header's, or the
        presentation time is not after the previous frame's."""
        if not self._last_pts_seconds < pts_seconds < math.inf:
            raise StreamError(
                f"Frame {index} is to be presented at {pts_seconds} s, which is not after the frame before it "
                f"({self._last_pts_seconds} s); the capture's time stamps must rise."
            )
        state = state_of(scene)
        coded = None if self._compact is None else self._compact.encode(state, kind=kind, index=index)
        blocks: dict[FieldName, bytes] = {
            row.name: pack_raw_block(row.name, state[row.name])
            if coded is None
            else pack_coded_block(row.name, coded[row.name])
            for row in STATE_TABLE
            if row.name in self._header.dynamic
        }
        packet = packet_from_blocks(blocks, index=index, pts_seconds=pts_seconds, kind=kind)
        encoded = Encoded(packet, self._decoder.decode(packet))
        self._last_pts_seconds = pts_seconds
        return encoded
