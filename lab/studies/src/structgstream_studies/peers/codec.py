# SPDX-License-Identifier: Apache-2.0
"""The codec of peers, with frames as packets of named arrays, and their pipeline."""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Generic

import torch

from structgstream.codec.container.byte_source import FileBytes
from structgstream.codec.container.records import PREFIX, read_record
from structgstream.codec.packets import Packet, PacketKind, StreamHeader
from structgstream.codec.scene_coder import Encoded
from structgstream.scene.state import STATE_TABLE
from structgstream.session.pipeline import FrameTask, Memory, Pipeline, State, StreamFacts
from structgstream.session.presets import RIG, to_json
from structgstream_studies.peers.container import PeerReader, PeerSink, arrays_of, check_prefix, parse_packet
from structgstream_studies.peers.method import PeerMethod


class PeerCoder(Generic[State]):
    """Encodes and decodes the frames of one file, in order.

    Args:
        method: converts states to arrays and back.
        device: of decoded states.
    """

    def __init__(self, method: PeerMethod[State, Memory], device: torch.device) -> None:
        self._arrays, self._restored = method.arrays, method.restored
        self._device = device
        self._state: State | None = None

    def encode(self, state: State, *, index: int, pts_seconds: float, kind: PacketKind) -> Encoded[State]:
        """The packet of a frame, and its reconstruction."""
        packet = parse_packet(self._arrays(state), index=index, pts_seconds=pts_seconds, kind=kind)
        return Encoded(packet, self.replay(packet))

    def replay(self, packet: Packet) -> State:
        """Decode a packet, and continue after it."""
        previous = None if packet.kind is PacketKind.KEY else self._state
        arrays = arrays_of(packet, where=f"Frame {packet.index}")
        self._state = self._restored(arrays, previous, device=self._device)
        return self._state


@dataclass(frozen=True)
class PeerCodec(Generic[State, Memory]):
    """A peer's file: its frames as named arrays."""

    method: PeerMethod[State, Memory]

    @property
    def name(self) -> str:
        """The method's."""
        return self.method.name

    def key_interval(self, fps: float) -> int:
        """1 if every frame is a key frame; otherwise only the first one is."""
        return 1 if self.method.stands_alone else sys.maxsize

    def file(self, path: Path, *, frames: int | None, resume: bool) -> tuple[PeerSink, PeerReader[State] | None]:
        """The file, which is replaced unless it is resumed and holds a whole frame.

        Raises:
            StreamError: what is to be resumed is no file of a peer.
        """
        reader = self._existing(path) if resume and path.exists() else None
        return PeerSink(path, frames=frames, resumed=reader), reader

    def _existing(self, path: Path) -> PeerReader[State] | None:
        data = FileBytes(path)
        if len(data) < PREFIX.size:
            return None
        check_prefix(data, str(path))
        if read_record(data, PREFIX.size) is None:
            return None
        reader = PeerReader(data, lambda _: self.method, name=str(path))
        return reader if len(reader) else None

    def prepare(self, fitted: State, task: FrameTask, facts: StreamFacts) -> tuple[State, StreamHeader]:
        """Frame 0 unchanged, and the header, which has none of its data."""
        return fitted, StreamHeader(
            rig=facts.rig,
            similarity=facts.similarity,
            fps=facts.fps,
            codec=facts.codec,
            dynamic=frozenset(field.name for field in STATE_TABLE),
            static={},
            distance_input=False,
            config=facts.config,
            metadata=facts.metadata,
        )

    def coder(self, header: StreamHeader, device: torch.device) -> PeerCoder[State]:
        """The coder, on ``device``."""
        return PeerCoder(self.method, device)


def peer_pipeline(method: PeerMethod[State, Memory], *, seed: int = 0) -> Pipeline[State, Memory]:
    """A peer with the initial points, normalisation and seeds of the preset ``rig``."""
    return Pipeline(
        method,
        PeerCodec(method),
        config=to_json(method.config),
        seed=seed,
        points=RIG.points,
        metadata={"seed": seed},
    )
