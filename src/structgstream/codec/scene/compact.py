# SPDX-License-Identifier: Apache-2.0
"""The compact codec: bins predicted from the previous frame's, entropy coded (docs/bitstream.md, section Compact).

A key packet is predicted from the header's reference state and starts with fresh models, so each group of packets (a
key packet and the delta packets up to the next one) can be decoded by itself.
"""

from collections.abc import Mapping
from dataclasses import dataclass

from torch import Tensor

from structgstream.codec.arrays import Bins
from structgstream.codec.entropy.adaptive import AdaptiveCoder, AdaptiveDecoder, AdaptiveEncoder
from structgstream.codec.entropy.models import Models
from structgstream.codec.packets import PacketKind, StreamHeader
from structgstream.codec.scene.bins import LARGEST, SceneBins, dequantize_state, quantize_state, quantized_fields
from structgstream.codec.scene.change import Change
from structgstream.codec.scene.free_rows import code_free
from structgstream.codec.scene.rows import code_change
from structgstream.errors import StreamError
from structgstream.scene.state import FieldName, fields_of, parameters_of

FREE_FIELDS: frozenset[FieldName] = frozenset(fields_of("free"))
"""Births, deaths and changes of free Gaussians are coded together: these fields are all dynamic, or none is."""
CODABLE: frozenset[FieldName] = frozenset(quantized_fields("anchor") + quantized_fields("shared")) | FREE_FIELDS
"""Fields that may be dynamic."""


def code_scene(
    coder: AdaptiveCoder, after: SceneBins | None, before: SceneBins, *, has_free: bool, where: str
) -> SceneBins:
    """Codes the bins of a frame given those of the frame ``before``, in either direction.

    Raises:
        StreamError: decoded values are out of range or inconsistent.
    """
    given = None if after is None else Change.of(after.anchors - before.anchors)
    change = code_change(coder, given, before.change, groups=before.columns)
    anchors = before.anchors + change.residuals
    weights: dict[FieldName, Bins] = {}
    changes: dict[FieldName, Change] = {}
    for name, bins in before.weights.items():
        given = None if after is None else Change.of(after.weights[name] - bins)
        changes[name] = code_change(coder, given, before.weight_changes[name], groups=[(name, 0, 1)])
        weights[name] = bins + changes[name].residuals
    free = before.free
    if has_free:
        free = code_free(coder, None if after is None else after.free, before.free, where=where)
    for found in (anchors, *weights.values(), free.bins):
        if found.size and not -LARGEST <= int(found.min()) <= int(found.max()) <= LARGEST:
            raise StreamError(f"{where} has a bin beyond 22 bits, the largest allowed; it is damaged.")
    return SceneBins(anchors, before.columns, change, weights, changes, free)


@dataclass(frozen=True)
class CompactState:
    """The state that encoder and decoder share after a packet."""

    index: int
    bins: SceneBins
    models: Models


class _Compact:
    """State that encoder and decoder share: the prediction of each packet.

    Raises:
        StreamError: the header has another codec, dynamic fields that cannot be coded, or no step or reference for one.
    """

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


class CompactEncoder(_Compact):
    """Encodes the frames of one stream, in order."""

    def replay(self, state: CompactState | None) -> None:
        """Continue from a decoder's state."""
        self.state = state

    def encode(self, state: Mapping[FieldName, Tensor], *, kind: PacketKind, index: int) -> dict[FieldName, bytes]:
        """The bytes of each dynamic field.

        Raises:
            StreamError: a value is out of range, or a delta packet does not follow the packet before it.
        """
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


class CompactDecoder(_Compact):
    """Decodes the frames of one stream in order, starting at any key packet."""

    def decode(
        self, fields: Mapping[FieldName, bytes | memoryview], *, kind: PacketKind, index: int
    ) -> dict[FieldName, Tensor]:
        """The dynamic fields of a frame.

        Raises:
            StreamError: the packet is damaged, or does not follow the one before it.
        """
        before, models = self._start(kind, index)
        decoder = AdaptiveDecoder(models, fields, where=f"Packet {index}")
        bins = self._code(decoder, None, before, index)
        decoder.end()
        self._keep(kind, index, bins, models)
        return dequantize_state(bins, self._header.dynamic, self._header.steps)
