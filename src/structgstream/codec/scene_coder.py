# SPDX-License-Identifier: Apache-2.0
"""Codes frames: packets to scenes, and scenes to packets (docs/bitstream.md, sections Packets and Compact).

With the codec ``compact`` bins are predicted from the previous frame's. A key packet is predicted from the header's
reference state and starts with fresh models, so each group of packets (a key packet and the delta packets up to the
next one) can be decoded by itself.

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

from structgstream.codec.container.blocks import pack_blocks, unpack_blocks
from structgstream.codec.container.records import FRAME
from structgstream.codec.entropy.adaptive import AdaptiveCoder, AdaptiveDecoder, AdaptiveEncoder
from structgstream.codec.entropy.decisions import Models
from structgstream.codec.fields.packet_fields import (
    CODABLE,
    FREE_FIELDS,
    SceneBins,
    code_scene,
    dequantize_state,
    quantize_state,
)
from structgstream.codec.packets import Packet, PacketKind, StreamHeader, check_codec, check_shapes, packet_from_blocks
from structgstream.errors import StreamError
from structgstream.scene.sampling import RigSampling
from structgstream.scene.scene import Scene
from structgstream.scene.state import FieldName, parameters_of, scene_of, state_of

SceneT = TypeVar("SceneT", covariant=True)


@dataclass(frozen=True)
class CompactState:
    """The state that encoder and decoder share after a packet."""

    index: int
    bins: SceneBins
    models: Models


class CompactCoder:
    """Encodes or decodes the frames of one stream in order; decoding may start at any key packet. Raises StreamError if
    the codec is unknown, or the header has dynamic fields that cannot be coded, or no step or reference for one."""

    def __init__(self, header: StreamHeader) -> None:
        check_codec(header.codec)
        if beyond := header.dynamic - CODABLE:
            raise StreamError(f"The compact codec has no coding for {', '.join(sorted(beyond))}; keep it static.")
        if header.dynamic & FREE_FIELDS not in (frozenset(), FREE_FIELDS):
            raise StreamError("The header announces free Gaussians without their births, or births without them.")
        rows = header.dynamic - FREE_FIELDS
        needed = {parameter.name for parameter in parameters_of(header.dynamic) if parameter.step}
        if missing := needed - header.steps.keys():
            raise StreamError(f"The header states no step for {', '.join(sorted(missing))}.")
        if header.reference.keys() != rows:
            raise StreamError("The header's reference state does not hold the dynamic fields of anchors and MLPs.")
        self._header = header
        known: dict[FieldName, Tensor] = {**header.static, **header.reference}
        # Static fields are not read; a key packet starts without free Gaussians.
        self._reference = quantize_state(known, rows, header.steps)
        self.state: CompactState | None = None

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

    def decode(
        self, fields: Mapping[FieldName, bytes | memoryview], *, kind: PacketKind, index: int
    ) -> dict[FieldName, Tensor]:
        """The dynamic fields of a frame. Raises StreamError if the packet is damaged, or does not follow the one before
        it."""
        before, models = self._start(kind, index)
        decoder = AdaptiveDecoder(models, fields, where=f"Packet {index}")
        bins = self._code(decoder, None, before, index)
        decoder.end()
        self._keep(kind, index, bins, models)
        return dequantize_state(bins, self._header.dynamic, self._header.steps)

    def _start(self, kind: PacketKind, index: int) -> tuple[SceneBins, Models]:
        if kind is PacketKind.KEY:
            return self._reference, Models()
        if self.state is None or self.state.index != index - 1:
            raise StreamError(f"Packet {index} needs packet {index - 1}, which was not decoded before it.")
        return self.state.bins, Models(self.state.models)

    def _code(self, coder: AdaptiveCoder, after: SceneBins | None, before: SceneBins, index: int) -> SceneBins:
        has_free = not FREE_FIELDS.isdisjoint(self._header.dynamic)
        return code_scene(coder, after, before, has_free=has_free, where=f"Packet {index}")

    def _keep(self, kind: PacketKind, index: int, bins: SceneBins, models: Models) -> None:
        # Residuals of a key packet are relative to the reference, so they do not predict those of the next packet.
        self.state = CompactState(index, bins.without_change() if kind is PacketKind.KEY else bins, models)


class SceneDecoder:
    """Decodes the packets of one stream, in order: a delta packet follows the packet before it.

    Key packets, and with the ``raw`` codec all packets, can be decoded without the one before. Raises StreamError if
    the codec is unknown to this version, or the header is inconsistent with it.
    """

    def __init__(self, header: StreamHeader) -> None:
        self._header = header
        self._sampling = RigSampling.of(header.similarity.rig(header.rig))
        self._compact = None if header.codec == "raw" else CompactCoder(header)

    @property
    def state(self) -> CompactState | None:
        """The ``compact`` codec's state after the last packet."""
        return None if self._compact is None else self._compact.state

    def decode(self, packet: Packet) -> Scene:
        """The scene of one frame, on the CPU, in normalised units. Raises StreamError if the packet's fields are not
        the header's dynamic ones, their shapes are inconsistent, or the packet before it has not been decoded."""
        header, where = self._header, f"Packet {packet.index}"
        dynamic, coded = unpack_blocks(packet.payload, FRAME.size, where=where)
        if self._compact is None and coded:
            raise StreamError(f"{where} holds field {next(iter(coded))} coded; expected raw.")
        if self._compact is not None and dynamic:
            raise StreamError(f"{where} holds field {next(iter(dynamic))} raw; expected coded.")
        if (names := dynamic.keys() | coded.keys()) != header.dynamic:
            raise StreamError(
                f"{where} holds {', '.join(sorted(names)) or 'no field'}; "
                f"the header announces {', '.join(sorted(header.dynamic)) or 'none'}."
            )
        if self._compact is not None:
            dynamic = self._compact.decode(coded, kind=packet.kind, index=packet.index)
        fields: dict[FieldName, Tensor] = {**header.static, **dynamic}
        check_shapes(
            fields, distance_input=header.distance_input, training_cameras=len(header.rig.training), where=where
        )
        return scene_of(fields, distance_input=header.distance_input, sampling=self._sampling)


@dataclass(frozen=True)
class Encoded(Generic[SceneT]):
    """A packet and its reconstruction: the scene that a decoder gets."""

    packet: Packet
    reconstruction: SceneT


class SceneEncoder:
    """Encodes scenes of one stream, in order."""

    def __init__(self, header: StreamHeader) -> None:
        self._header = header
        self._decoder = SceneDecoder(header)
        self._compact = None if header.codec == "raw" else CompactCoder(header)
        self._last_pts_seconds = -math.inf

    def replay(self, packet: Packet) -> Scene:
        """Continue after ``packet`` of another encoder, and return its scene; call it for every packet of the group.
        Raises StreamError if it does not follow the packet before it, or is damaged."""
        scene = self._decoder.decode(packet)
        if self._compact is not None:
            self._compact.state = self._decoder.state
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
        coded = {} if self._compact is None else self._compact.encode(state, kind=kind, index=index)
        blocks = pack_blocks({name: state[name] for name in self._header.dynamic}, coded)
        packet = packet_from_blocks(blocks, index=index, pts_seconds=pts_seconds, kind=kind)
        encoded = Encoded(packet, self._decoder.decode(packet))
        self._last_pts_seconds = pts_seconds
        return encoded
