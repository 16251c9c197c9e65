# SPDX-License-Identifier: Apache-2.0
"""The part of a stream that all groups share: its init record and frame 0."""

import hashlib
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from structgstream.cameras import CameraRig
from structgstream.codec.container.byte_source import FileBytes
from structgstream.codec.container.records import PREFIX, RecordType, check_prefix, read_record
from structgstream.codec.packets import Packet, PacketKind, StreamHeader, parse_packet, unpack_header
from structgstream.codec.scene_coder import SceneDecoder
from structgstream.data.source import FrameSource, WithRig, section
from structgstream.errors import CaptureError, ConfigError, StreamError
from structgstream.evaluation.recording import capture_of
from structgstream.scene.scene import Scene
from structgstream.session.presets import StreamConfig, from_json


@dataclass(frozen=True)
class GroupBase:
    """The beginning of a stream. A group is fitted from it, its pictures and the track."""

    name: str  # of the file, for messages
    header: StreamHeader  # content of the init record
    init: bytes  # the bytes of prefix and init record
    first: bytes  # the bytes of the record of frame 0
    packet: Packet  # frame 0

    @classmethod
    def read(cls, path: Path | str) -> "GroupBase":
        """The beginning of the stream file ``path``, which may be longer. Raises StreamError if the file is not a
        stream, or is damaged or truncated before the end of frame 0."""
        data = FileBytes(path)
        check_prefix(data, str(path))
        init = read_record(data, PREFIX.size)
        first = None if init is None else read_record(data, init.end)
        if init is None or init.type != RecordType.INIT or first is None or first.type != RecordType.KEY:
            raise StreamError(
                f"{path} has no whole frame 0 at its beginning; make it with: structgstream reconstruct CAPTURE "
                f"--frames 1 --sound none -o {path} --overwrite"
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
        """The configuration of the stream, which is that of every group. Raises ConfigError if it cannot be read, has
        periods, sound or another codec than ``compact``, or was made without scene flow, which groups need."""
        config = from_json(self.header.config)
        check_for_groups(config, name=self.name)
        if self.header.sound is not None:
            raise ConfigError(
                f"{self.name} has sound, which groups do not carry; make it with --sound none, and give the joined "
                "stream its sound with structgstream add-sound."
            )
        return config

    @property
    def key_interval(self) -> int:
        """Frames from one key packet to the next."""
        return self.config.key_interval(self.header.fps)

    @property
    def position_step(self) -> float:
        """The quantization step of positions, in units of the scene."""
        return self.header.steps["anchor_positions"]

    def scene(self) -> Scene:
        """The decoded frame 0, on the CPU."""
        return SceneDecoder(self.header).decode(self.packet)


def check_for_groups(config: StreamConfig, *, name: str) -> None:
    """Check that groups can be fitted with the configuration of ``name``. Raises ConfigError if it has another codec,
    no scene flow, or periods."""
    if config.codec != "compact" or not (config.online.motion.enabled and config.online.scene_flow.enabled):
        raise ConfigError(
            f"{name} has codec {config.codec} and scene flow "
            f"{'on' if config.online.scene_flow.enabled else 'off'}; groups need the codec compact and scene flow, "
            "as in the presets compact and fast."
        )
    if config.period.enabled:
        raise ConfigError(f"{name} may begin other periods, and groups share one header; make it without them.")


def open_for(header: StreamHeader, folder: Path, *, frames: int | None) -> FrameSource:
    """The first ``frames`` frames of the capture that the stream of ``header`` was made from, with its rig.

    Picture size, first frame, held-out cameras and near planes are those of the header; frames count from its first.

    Raises:
        CaptureError: the capture has other cameras or fewer frames.
    """
    source = capture_of(header, folder, frames=None)
    if frames is not None and frames > len(source):
        raise CaptureError(f"The capture {source.name} has {len(source)} frames, but {frames} are needed.")
    source = section(source, frames=frames)
    if differing := _differing(source.rig, header.rig):
        raise CaptureError(
            f"The capture {source.name} is not the one of the header: {', '.join(differing[:5])} "
            f"{'differs' if len(differing) == 1 else 'differ'} in pose, lens or size. Give the capture that the header "
            "was made from."
        )
    return WithRig(source, header.rig)


def _differing(found: CameraRig, expected: CameraRig) -> list[str]:
    """Names of the cameras that differ between the rigs."""

    def same(name: str) -> bool:
        if name not in found.cameras or name not in expected.cameras:
            return False
        one, other = found[name], expected[name]
        sizes = (one.width, one.height) == (other.width, other.height)
        return sizes and bool((one.viewmat == other.viewmat).all()) and bool((one.K == other.K).all())

    return [name for name in dict.fromkeys([*expected, *found]) if not same(name)]


def fingerprint(source: FrameSource) -> str:
    """SHA-256 over the calibration, the split, the frame rate, and every camera's picture of frame 0."""
    digest = hashlib.sha256(f"{source.fps!r}\n".encode())
    for name in source.rig:
        camera = source.rig[name]
        split = "held out" if name in source.rig.held_out else "training"
        digest.update(f"{name} {split} {camera.width} {camera.height} {camera.near!r}\n".encode())
        digest.update(camera.viewmat.numpy().tobytes() + camera.K.numpy().tobytes())
    frame = next(source.frames(0))
    for name in source.rig:
        if name in frame.images:
            digest.update(name.encode() + np.ascontiguousarray(frame.images[name]).tobytes())
        if name in frame.masks:
            digest.update(np.packbits(frame.masks[name]).tobytes())
    return digest.hexdigest()
