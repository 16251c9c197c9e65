# SPDX-License-Identifier: Apache-2.0
"""The codec of a group: its first packet is a key packet, wherever it is."""

from dataclasses import dataclass

import torch

from structgstream.codec.encoder import Encoded, SceneEncoder
from structgstream.codec.packets import PacketKind, StreamHeader
from structgstream.scene.scene import Scene
from structgstream.scene_codecs import CompactCodec


@dataclass(frozen=True)
class GroupCodec(CompactCodec):
    """The codec ``compact`` with a key packet at the frame ``first``, besides the usual ones."""

    first: int = 0

    def coder(self, header: StreamHeader, device: torch.device) -> SceneEncoder:
        """The encoder of the group, on the CPU."""
        return _GroupEncoder(header, self.first)


class _GroupEncoder(SceneEncoder):
    def __init__(self, header: StreamHeader, first: int) -> None:
        super().__init__(header)
        self._first = first

    def encode(self, scene: Scene, *, index: int, pts_seconds: float, kind: PacketKind) -> Encoded[Scene]:
        kind = PacketKind.KEY if index == self._first else kind
        return super().encode(scene, index=index, pts_seconds=pts_seconds, kind=kind)
