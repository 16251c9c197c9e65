# SPDX-License-Identifier: Apache-2.0
"""The part of a stream that all groups share: its init record and frame 0."""

import hashlib
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from structgstream.codec.container.byte_source import FileBytes
from structgstream.codec.container.records import PREFIX, RecordType, check_prefix, read_record
from structgstream.codec.decoder import SceneDecoder
from structgstream.codec.header import unpack_header
from structgstream.codec.packets import Packet, PacketKind, StreamHeader, parse_packet
from structgstream.errors import ConfigError, StreamError
from structgstream.scene.scene import Scene
from structgstream.session.presets import StreamConfig, from_json


@dataclass(frozen=True)
class GroupBase:
    """The beginning of a stream. A group is fitted from it, its pictures and the track.

    Args:
        name: of the file, for messages.
        header: content of the init record.
        init: the bytes of prefix and init record.
        first: the bytes of the record of frame 0.
        packet: frame 0.
    """

    name: str
    header: StreamHeader
    init: bytes
    first: bytes
    packet: Packet

    @classmethod
    def read(cls, path: Path | str) -> "GroupBase":
        """The beginning of the stream file ``path``, which may be longer.

        Raises:
            StreamError: the file is not a stream, or is damaged or truncated before the end of frame 0.
        """
        data = FileBytes(path)
        check_prefix(data, str(path))
        init = read_record(data, PREFIX.size)
        first = None if init is None else read_record(data, init.end)
        if init is None or init.type != RecordType.INIT or first is None or first.type != RecordType.KEY:
            raise StreamError(
                f"{path} has no whole frame 0 at its beginning; make it with: structgstream reconstruct CAPTURE "
                f"--frames 1 -o {path} --overwrite"
            )
        head, record = bytes(data[: init.end]), bytes(data[init.end : first.end])
        data.close()
        packet = parse_packet(first.payload, PacketKind.KEY)
        return cls(str(path), unpack_header(init.payload), head, record, packet)

    @property
    def sha256(self) -> str:
        """Of the bytes of prefix, init record and frame 0."""
        return hashlib.sha256(self.init + self.first).hexdigest()

    @cached_property
    def config(self) -> StreamConfig:
        """The configuration of the stream, which is that of every group.

        Raises:
            ConfigError: it cannot be read, has periods, or was made without scene flow, which groups need.
        """
        config = from_json(self.header.config)
        if config.codec != "compact" or not (config.online.motion.enabled and config.online.scene_flow.enabled):
            raise ConfigError(
                f"{self.name} was made with codec {config.codec} and scene flow "
                f"{'on' if config.online.scene_flow.enabled else 'off'}; groups need the codec compact and scene flow, "
                "as in the presets compact and fast."
            )
        if config.period.enabled:
            raise ConfigError(
                f"{self.name} may begin other periods, and groups share one header; make it without them."
            )
        return config

    @property
    def key_interval(self) -> int:
        """Frames from one key packet to the next."""
        return max(1, round(self.header.fps * self.config.key_interval_seconds))

    @property
    def position_step(self) -> float:
        """The quantization step of positions, in units of the scene."""
        return self.header.steps["anchor_positions"]

    def scene(self) -> Scene:
        """The decoded frame 0, on the CPU."""
        return SceneDecoder(self.header).decode(self.packet)
