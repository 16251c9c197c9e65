# SPDX-License-Identifier: Apache-2.0
"""The parts of a stream: packets, the protocol of their sinks, and the header, packed and unpacked as an init record,
with the shapes that fit together (docs/bitstream.md, Init record, Fields)."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import chain
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from structgstream.cameras import Camera, CameraRig, Similarity
from structgstream.codec.container.blocks import (
    first_block,
    iterate_blocks,
    pack_blocks,
    pack_init,
    read_description,
    unpack_blocks,
)
from structgstream.codec.container.records import FRAME, PacketKind, RecordType, packed
from structgstream.codec.fields.static_fields import UNCODED_FIELDS, decode_fields, encode_fields
from structgstream.codec.sound import SoundFormat, sound_format
from structgstream.errors import CalibrationError, ConfigError, StreamError
from structgstream.scene.state import FIELDS, STATE_TABLE, FieldName


@dataclass(frozen=True)
class StreamHeader:
    """The content of the init record, which a receiver reads before the first frame.

    Args:
        rig: every camera of the capture, in the capture's own units, with the held-out set of the training run.
        similarity: from the capture's units to the scene's.
        fps: frames per second.
        codec: coding of the fields: ``raw`` or ``compact``.
        dynamic: the fields that packets carry; all others are in ``static``.
        static: the fields that are constant over the period of this header, exactly as the decoder uses them.
        distance_input: whether the distance to the camera is an input of the MLPs.
        config: the resolved configuration of the run, as plain JSON values.
        metadata: capture name, creator, start frame and the like, as plain JSON values.
        steps: ``compact`` only: quantization steps by parameter (``fields``), each a float32 number.
        reference: ``compact`` only: the dynamic fields of anchors and MLPs from which key packets are predicted.
        init_steps: ``compact`` only: quantization steps by field of ``static`` and ``reference``
            (``static_fields.py``), each a float32 number.
        periods: whether other periods, with init records of their own, may follow.
        sound: what is stored beside the frames; None for no sound, or one of a codec that this version does not know.
        unknown_sound: what a read init record states of such a sound; it is not written.
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
    unknown_sound: Mapping[str, Any] | None = None

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
    """The packet of a frame with these field blocks, in this order. Raises StreamError if the stream is as long as it
    can be."""
    # Identities of free Gaussians are frame * 2^32 + number, of 63 bits. 2^31 frames are 2.27 years at 30 a second.
    if index >= MAX_FRAMES:
        raise StreamError(f"A stream has at most {MAX_FRAMES} frames; begin another one.")
    payload = FRAME.pack(index, pts_seconds) + b"".join(blocks.values())
    return Packet(kind, index, pts_seconds, payload, {name: len(block) for name, block in blocks.items()})


def parse_packet(payload: bytes, kind: PacketKind) -> Packet:
    """The packet in a key or delta record. Raises StreamError if the payload violates the format."""
    if len(payload) < FRAME.size:
        raise StreamError("A packet is too short to hold its index and time.")
    index, pts_seconds = FRAME.unpack_from(payload)
    if not math.isfinite(pts_seconds):
        raise StreamError(f"Packet {index} has the presentation time {pts_seconds}; it is damaged.")
    blocks = iterate_blocks(payload, FRAME.size, where=f"Packet {index}")
    return Packet(kind, index, pts_seconds, payload, {block.name: block.end - block.start for block in blocks})


ENVIRONMENT_ROWS = (1, 4, 9)
"""Numbers of spherical harmonics up to degree 0, 1 and 2."""


def check_shapes(
    fields: Mapping[FieldName, Tensor], *, distance_input: bool, training_cameras: int, where: str
) -> None:
    """Check that the shapes of the fields present are consistent. Raises StreamError that names the first field of
    another shape, its shape and the expected one."""
    sizes: dict[str, int] = {"V": training_cameras}
    for name, value in fields.items():
        _match(name, value, sizes, where)
    if sizes.get("E", 1) not in ENVIRONMENT_ROWS:
        raise StreamError(f"{where} has an environment of {sizes['E']} rows; expected 1, 4 or 9.")
    if not {"K", "D"} <= set(sizes):
        return
    if sizes["K"] < 1 or sizes["D"] < 1:
        raise StreamError(
            f"{where} has {sizes['K']} Gaussians and {sizes['D']} features an anchor; expected at least 1."
        )
    inputs = sizes["D"] + 3 + int(distance_input)
    hidden: int | None = None
    for name, row in FIELDS.items():
        if not row.outputs or name not in fields:
            continue
        weights, outputs = len(fields[name]), row.outputs * sizes["K"]
        units, rest = divmod(weights - outputs, inputs + 1 + outputs)
        if rest or units < 1 or units != (hidden or units):
            raise StreamError(
                f"{where} has an MLP of {weights} weights, which fits no hidden layer between {inputs} inputs and "
                f"{outputs} outputs, or not the size of the other MLPs' hidden layer."
            )
        hidden = units


def _match(name: FieldName, value: Tensor, sizes: dict[str, int], where: str) -> None:
    shape = FIELDS[name].shape
    fits = value.dim() == len(shape) and (value.dtype == torch.int64) == FIELDS[name].integers
    for size, expected in zip(value.shape, shape):
        fits = fits and size == (sizes.setdefault(expected, size) if isinstance(expected, str) else expected)
    if not fits:
        wanted = [str(sizes.get(e, e)) if isinstance(e, str) else str(e) for e in shape]
        raise StreamError(
            f"{where} has field {name} as {tuple(value.shape)} {value.dtype}, which does not fit the others; expected "
            f"({', '.join(wanted)})."
        )


MAX_IMAGE_SIDE = 65_535
MAX_IMAGE_PIXELS = 2**26
"""8192 x 8192: more than any camera's video, and 0.8 GB as floats, so that a small file cannot fill the memory."""
_MIN_STEP = 2.0**-64


def pack_header(header: StreamHeader) -> bytes:
    """The payload of an init record.

    Raises:
        CalibrationError: a camera has more pixels than the format allows.
        StreamError: the description is too long, or, with codec ``compact``, a field is not quantized.
    """
    check_picture_sizes(header.rig)
    description = {
        "cameras": [
            {
                **values,
                "name": name,
                "viewmat": header.rig[name].viewmat.flatten().tolist(),
                "K": header.rig[name].K.flatten().tolist(),
            }
            for name, values in header.rig.plain().items()
        ],
        "similarity": {"center": list(header.similarity.center), "scale": header.similarity.scale},
        "fps": header.fps,
        "codec": header.codec,
        "dynamic": sorted(header.dynamic),
        "distance_input": header.distance_input,
        "config": header.config,
        "metadata": header.metadata,
        **({"steps": dict(header.steps)} if header.steps else {}),
        **({"init_steps": dict(header.init_steps)} if header.init_steps else {}),
        **({"periods": True} if header.periods else {}),
        **({"sound": header.sound.plain()} if header.sound else {}),
    }
    fields: dict[FieldName, Tensor] = {**header.static, **header.reference}
    coded = encode_fields(fields, header.init_steps) if header.codec == "compact" else {}
    blocks = (pack_blocks(part, coded).values() for part in (header.static, header.reference))
    return pack_init(description, chain(*blocks))


def check_picture_sizes(rig: CameraRig) -> None:
    """Check that a stream can have these cameras, which costs nothing before training. Raises CalibrationError if the
    pictures of a camera are larger than the format allows."""
    for name in rig:
        width, height = rig[name].width, rig[name].height
        if max(width, height) > MAX_IMAGE_SIDE or width * height > MAX_IMAGE_PIXELS:
            raise CalibrationError(
                f"The pictures of camera {name!r} have {width}x{height} pixels; a stream holds cameras of at most "
                f"{MAX_IMAGE_PIXELS} pixels and {MAX_IMAGE_SIDE} a side: use smaller pictures (--scale 0.5)."
            )


def unpack_header(payload: bytes) -> StreamHeader:
    """The header of an init record's payload. Raises StreamError if the payload violates the format."""
    values, coded = unpack_blocks(payload, first_block(payload), where="The init record")
    try:
        description = read_description(payload)
        header = _header(description, _fields(description, values, coded))
    except (ValueError, KeyError, TypeError, RuntimeError, ArithmeticError, CalibrationError) as error:
        raise StreamError(f"The init record does not follow the format ({error or type(error).__name__}).") from error
    names = header.dynamic | header.static.keys()
    begun = {row.optional for row in STATE_TABLE if row.name in names}
    complete = {row.name for row in STATE_TABLE if row.optional is None or row.optional in begun}
    if names != complete or (header.reference and header.codec == "raw"):
        check_codec(header.codec)
        raise StreamError("The init record must hold exactly the fields that packets do not carry.")
    check_shapes(
        {**header.static, **header.reference},
        distance_input=header.distance_input,
        training_cameras=len(header.rig.training),
        where="The init record",
    )
    return header


def check_codec(codec: str) -> None:
    """Raises StreamError if this version does not know the codec."""
    if codec not in ("raw", "compact"):
        raise StreamError(
            f"The stream is coded with {codec!r}; this version knows 'raw' and 'compact'. "
            "Install a newer structgstream."
        )


def _fields(
    description: dict[str, Any], values: dict[FieldName, Tensor], coded: dict[FieldName, memoryview]
) -> dict[FieldName, Tensor]:
    if description["codec"] != "compact":
        if coded:
            check_codec(str(description["codec"]))
            raise StreamError(f"The init record holds field {next(iter(coded))} coded; codec 'raw' has no coding.")
        return values
    if plain := sorted(values.keys() - UNCODED_FIELDS):
        raise StreamError(f"The init record holds field {plain[0]} raw; expected coded.")
    return values | decode_fields(coded, _steps(description.get("init_steps", {})))


def _steps(found: object) -> dict[Any, float]:
    if not isinstance(found, dict):
        raise TypeError("steps must be objects")
    return {name: _step(value) for name, value in found.items()}


def _header(description: dict[str, Any], static: Mapping[FieldName, Tensor]) -> StreamHeader:
    cameras = {entry["name"]: _camera(entry) for entry in description["cameras"]}
    if len(cameras) != len(description["cameras"]) or not all(isinstance(name, str) for name in cameras):
        raise ValueError("camera names must be texts, each used once")
    if not all(isinstance(entry["held_out"], bool) for entry in description["cameras"]):
        raise TypeError("held_out must be true or false")
    dynamic: frozenset[FieldName] = frozenset(description["dynamic"])
    x, y, z = (_number(value) for value in description["similarity"]["center"])
    plain = [description["config"], description["metadata"]]
    flags = [description["distance_input"], description.get("periods", False)]
    if not all(isinstance(value, dict) for value in plain) or not all(isinstance(value, bool) for value in flags):
        raise TypeError("config and metadata must be objects, distance_input and periods true or false")
    if unknown := sorted(map(repr, dynamic - FIELDS.keys())):
        raise StreamError(
            f"The init record announces field {unknown[0]} in packets, which this version does not know; "
            "install a newer structgstream."
        )
    sound = sound_format(description.get("sound"))
    return StreamHeader(
        rig=CameraRig(cameras, frozenset(entry["name"] for entry in description["cameras"] if entry["held_out"])),
        similarity=Similarity((x, y, z), _positive(description["similarity"]["scale"])),
        fps=_positive(description["fps"]),
        codec=str(description["codec"]),
        dynamic=dynamic,
        static={name: value for name, value in static.items() if name not in dynamic},
        distance_input=description["distance_input"],
        config=description["config"],
        metadata=description["metadata"],
        steps=_steps(description.get("steps", {})),
        init_steps=_steps(description.get("init_steps", {})),
        reference={name: value for name, value in static.items() if name in dynamic},
        periods=flags[1],
        sound=sound,
        unknown_sound=None if sound else description.get("sound"),
    )


def _step(value: object) -> float:
    # Within these bounds the product of step and bin is neither infinite nor denormal.
    if not _MIN_STEP <= (step := _positive(value)) <= 1 / _MIN_STEP or float(np.float32(step)) != step:
        raise ValueError(f"the step {value!r}; it must be a float32 number from 2^-64 to 2^64")
    return step


def _camera(entry: dict[str, Any]) -> Camera:
    width, height = entry["width"], entry["height"]
    if not all(type(size) is int and 0 < size <= MAX_IMAGE_SIDE for size in (width, height)):
        raise ValueError(f"a picture of {width}x{height} pixels; each side must be 1 to {MAX_IMAGE_SIDE}")
    if width * height > MAX_IMAGE_PIXELS:
        raise ValueError(f"a picture of {width}x{height}; the pixels of a picture must be at most {MAX_IMAGE_PIXELS}")
    return Camera(
        viewmat=torch.tensor([_number(value) for value in entry["viewmat"]], dtype=torch.float64).reshape(4, 4),
        K=torch.tensor([_number(value) for value in entry["K"]], dtype=torch.float64).reshape(3, 3),
        width=width,
        height=height,
        near=_positive(entry["near"]),
    )


def _number(value: object) -> float:
    """Checks for a finite number; JSON readers differ in what else they accept."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ValueError(f"{value!r} where a finite number belongs")
    return float(value)


def _positive(value: object) -> float:
    if (number := _number(value)) <= 0:
        raise ValueError(f"{value!r} where a positive number belongs")
    return number
