# SPDX-License-Identifier: Apache-2.0
"""Decodes packets to scenes (docs/bitstream.md, sections Packets and Compact).

With the codec ``compact`` bins are predicted from the previous frame's. A key packet is predicted from the header's
reference state and starts with fresh models, so each group of packets (a key packet and the delta packets up to the
next one) can be decoded by itself.
"""

from collections.abc import Mapping, Set
from dataclasses import dataclass

from torch import Tensor

from structgstream.codec.container.blocks import coded_payloads, unpack_raw_blocks
from structgstream.codec.container.records import FRAME
from structgstream.codec.entropy.adaptive import AdaptiveCoder, AdaptiveDecoder
from structgstream.codec.entropy.decisions import Models
from structgstream.codec.fields.packet_fields import (
    CODABLE,
    FREE_FIELDS,
    SceneBins,
    code_scene,
    dequantize_state,
    quantize_state,
)
from structgstream.codec.packets import Packet, PacketKind, StreamHeader, check_shapes
from structgstream.errors import StreamError
from structgstream.scene.sampling import RigSampling
from structgstream.scene.scene import Scene
from structgstream.scene.state import FieldName, parameters_of, scene_of


@dataclass(frozen=True)
class CompactState:
    """The state that encoder and decoder share after a packet."""

    index: int
    bins: SceneBins
    models: Models


class CompactCoder:
    """State that encoder and decoder share: the prediction of each packet. Raises StreamError if the header has another
    codec, dynamic fields that cannot be coded, or no step or reference for one."""

    def __init__(self, header: StreamHeader) -> None:
        if header.codec != "compact":
            raise StreamError(
                f"The stream is coded with {header.codec!r}; this version knows 'raw' and 'compact'. "
                "Install a newer structgstream."
            )
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


class CompactDecoder(CompactCoder):
    """Decodes the frames of one stream in order, starting at any key packet."""

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
        """The scene of one frame, on the CPU, in normalised units. Raises StreamError if the packet's fields are not
        the header's dynamic ones, their shapes are inconsistent, or the packet before it has not been decoded."""
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
