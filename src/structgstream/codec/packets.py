# SPDX-License-Identifier: Apache-2.0
"""The parts of a stream: header, packets, and the protocol of packet sinks."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

from torch import Tensor

from structgstream.cameras import Camera, CameraRig
from structgstream.codec.packet_kind import PacketKind
from structgstream.errors import ConfigError
from structgstream.scene.state import FieldName
from structgstream.similarity import Similarity

__all__ = ["Packet", "PacketKind", "PacketSink", "StreamHeader"]


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
        steps: ``compact`` only: quantization steps by parameter (``bins.py``), each a float32 number.
        reference: ``compact`` only: the dynamic fields of anchors and MLPs from which key packets are predicted.
        init_steps: ``compact`` only: quantization steps by field of ``static`` and ``reference``
            (``static_fields.py``), each a float32 number.
        periods: whether other periods, with init records of their own, may follow.
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
    """

    kind: PacketKind
    index: int
    pts_seconds: float
    payload: bytes
    field_bytes: Mapping[str, int]

    def __repr__(self) -> str:
        return f"Packet({self.kind.name}, index={self.index}, {len(self.payload)} bytes)"


class PacketSink(Protocol):
    """Receives a stream. ``write`` returns the number of bytes that the packet takes in the sink."""

    def open(self, header: StreamHeader) -> int: ...

    def begin(self, header: StreamHeader) -> int:
        """Begin another period with the next packet, a key packet; returns the bytes of its init record."""
        ...

    def write(self, packet: Packet) -> int: ...

    def close(self) -> None: ...
