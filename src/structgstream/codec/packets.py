# SPDX-License-Identifier: Apache-2.0
"""The parts of a stream: header, packets and their payload, and the protocol of packet sinks."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

from torch import Tensor

from structgstream.cameras import Camera, CameraRig
from structgstream.codec.container.blocks import iterate_blocks
from structgstream.codec.container.records import FRAME, PacketKind, RecordType, packed
from structgstream.codec.sound import SoundFormat
from structgstream.errors import ConfigError, StreamError
from structgstream.scene.state import FieldName
from structgstream.similarity import Similarity

__all__ = ["Packet", "PacketKind", "PacketSink", "StreamHeader", "packet_from_blocks", "parse_packet", "sound_record"]


@dataclass(frozen=True)
class StreamHeader:
    """The content of the init record, which a receiver reads before the first frame.

    Args:
        rig: every camera of the capture, in the capture's own units, with the held-out set of the training run.
        similarity: from the capture's units to the scene's.
        fps: frames per second.
        codec: coding of the fields: ``raw`` or ``compact``.
        dynamic: the fields that packets carry; all others are in ``static``.
        static: the fields that are constant over the stream, exactly as the decoder uses them.
        distance_input: whether the distance to the camera is an input of the MLPs.
        config: the resolved configuration of the run, as plain JSON values.
        metadata: capture name, creator, start frame and the like, as plain JSON values.
        steps: ``compact`` only: quantization steps by parameter (``fields``), each a float32 number.
        reference: ``compact`` only: the dynamic fields of anchors and MLPs from which key packets are predicted.
        init_steps: ``compact`` only: quantization steps by field of ``static`` and ``reference``
            (``static_fields.py``), each a float32 number.
        periods: whether other periods, with init records of their own, may follow.
        sound: what is stored beside the frames; None for no sound.
    """

    rig: CameraRig
    similarity: Similarity
    fps: float
    codec: str
    dynamic: frozenset[FieldName]
    static: Mapping[FieldName, Tensor]
    distance_input: bool
    config: Mapping[str, Any]
    metadata: Mapping[str, Any]
    steps: Mapping[str, float] = field(default_factory=dict)
    reference: Mapping[FieldName, Tensor] = field(default_factory=dict)
    init_steps: Mapping[FieldName, float] = field(default_factory=dict)
    periods: bool = False
    sound: SoundFormat | None = None

    def camera(self, camera: Camera | str) -> Camera:
        """A camera in the normalised units of the decoded scenes; it shows the same picture.

        Args:
            camera: the name of one of the rig, or any camera in the units of the capture.

        Raises:
            ConfigError: the rig has no camera of that name.
        """
        if isinstance(camera, str):
            if camera not in self.rig.cameras:
                raise ConfigError(f"The stream has no camera {camera!r}; it has {', '.join(self.rig)}.")
            camera = self.rig[camera]
        return self.similarity.camera(camera)


@dataclass(frozen=True)
class Packet:
    """One coded frame.

    Args:
        kind: key or delta.
        index: frame number in the stream, from 0, without gaps.
        pts_seconds: presentation time.
        payload: the coded fields.
        field_bytes: length of each field's part of the payload.
        sound: payload of the sound record that follows; None in a stream without sound.
    """

    kind: PacketKind
    index: int
    pts_seconds: float
    payload: bytes
    field_bytes: Mapping[str, int]
    sound: bytes | None = None

    def __repr__(self) -> str:
        return f"Packet({self.kind.name}, index={self.index}, {len(self.payload)} bytes)"


def sound_record(packet: Packet) -> bytes:
    """The record of a packet's sound; nothing in a stream without sound."""
    return b"" if packet.sound is None else packed(RecordType.SOUND, packet.sound)


class PacketSink(Protocol):
    """Receives a stream. ``write`` returns the number of bytes that the packet takes in the sink."""

    def open(self, header: StreamHeader) -> int: ...

    def begin(self, header: StreamHeader) -> int:
        """Begin another period with the next packet, a key packet; returns the bytes of its init record."""
        ...

    def write(self, packet: Packet) -> int: ...

    def close(self) -> None: ...


MAX_FRAMES = 2**31
"""Frames of a stream."""


def packet_from_blocks(
    blocks: Mapping[FieldName, bytes], *, index: int, pts_seconds: float, kind: PacketKind
) -> Packet:
    """The packet of a frame with these field blocks, in this order.

    Raises:
        StreamError: the stream is as long as it can be.
    """
    # Identities of free Gaussians are frame * 2^32 + number, of 63 bits. 2^31 frames are 2.27 years at 30 a second.
    if index >= MAX_FRAMES:
        raise StreamError(f"A stream has at most {MAX_FRAMES} frames; begin another one.")
    payload = FRAME.pack(index, pts_seconds) + b"".join(blocks.values())
    return Packet(kind, index, pts_seconds, payload, {name: len(block) for name, block in blocks.items()})


def parse_packet(payload: bytes, kind: PacketKind) -> Packet:
    """The packet in a key or delta record.

    Raises:
        StreamError: the payload violates the format.
    """
    if len(payload) < FRAME.size:
        raise StreamError("A packet is too short to hold its index and time.")
    index, pts_seconds = FRAME.unpack_from(payload)
    if not math.isfinite(pts_seconds):
        raise StreamError(f"Packet {index} has the presentation time {pts_seconds}; it is damaged.")
    blocks = iterate_blocks(payload, FRAME.size, where=f"Packet {index}")
    return Packet(kind, index, pts_seconds, payload, {block.name: block.end - block.start for block in blocks})
