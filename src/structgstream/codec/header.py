# SPDX-License-Identifier: Apache-2.0
"""The init record: packed, unpacked, and which shapes fit together (docs/bitstream.md, Init record, Fields)."""

import math
from collections.abc import Mapping, Set
from typing import Any

import numpy as np
import torch
from torch import Tensor

from structgstream.cameras import Camera, CameraRig
from structgstream.codec.container.blocks import (
    first_block,
    pack_coded_block,
    pack_init,
    pack_raw_block,
    read_description,
    unpack_blocks,
)
from structgstream.codec.fields.static_fields import UNCODED_FIELDS, decode_fields, encode_fields
from structgstream.codec.packets import StreamHeader
from structgstream.codec.sound import sound_format
from structgstream.errors import CalibrationError, StreamError
from structgstream.scene.state import FIELDS, STATE_TABLE, FieldName
from structgstream.similarity import Similarity

ENVIRONMENT_ROWS = (1, 4, 9)
"""Numbers of spherical harmonics up to degree 0, 1 and 2."""


def check_shapes(
    fields: Mapping[FieldName, Tensor], *, distance_input: bool, training_cameras: int, where: str
) -> None:
    """Check that the shapes of the fields present are consistent.

    Raises:
        StreamError: naming the first field of another shape, its shape and the expected one.
    """
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
                "name": name,
                "viewmat": header.rig[name].viewmat.flatten().tolist(),
                "K": header.rig[name].K.flatten().tolist(),
                "width": header.rig[name].width,
                "height": header.rig[name].height,
                "near": header.rig[name].near,
                "held_out": name in header.rig.held_out,
            }
            for name in header.rig
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
    blocks = [
        pack_coded_block(f.name, coded[f.name]) if f.name in coded else pack_raw_block(f.name, part[f.name])
        for part in (header.static, header.reference)
        for f in STATE_TABLE
        if f.name in part
    ]
    return pack_init(description, blocks)


def check_picture_sizes(rig: CameraRig) -> None:
    """Check that a stream can have these cameras, which costs nothing before training.

    Raises:
        CalibrationError: the pictures of a camera are larger than the format allows.
    """
    for name in rig:
        width, height = rig[name].width, rig[name].height
        if max(width, height) > MAX_IMAGE_SIDE or width * height > MAX_IMAGE_PIXELS:
            raise CalibrationError(
                f"The pictures of camera {name!r} have {width}x{height} pixels; a stream holds cameras of at most "
                f"{MAX_IMAGE_PIXELS} pixels and {MAX_IMAGE_SIDE} a side: use smaller pictures (--scale 0.5)."
            )


def unpack_header(payload: bytes) -> StreamHeader:
    """The header of an init record's payload.

    Raises:
        StreamError: the payload violates the format.
    """
    values, coded = unpack_blocks(payload, first_block(payload), where="The init record")
    try:
        description = read_description(payload)
        header = _header(description, _fields(description, values, coded))
    except (ValueError, KeyError, TypeError, RuntimeError, ArithmeticError, CalibrationError) as error:
        raise StreamError(f"The init record does not follow the format ({error or type(error).__name__}).") from error
    if not _complete(header.dynamic | header.static.keys()) or (header.reference and header.codec == "raw"):
        raise StreamError("The init record must hold exactly the fields that packets do not carry.")
    check_shapes(
        {**header.static, **header.reference},
        distance_input=header.distance_input,
        training_cameras=len(header.rig.training),
        where="The init record",
    )
    return header


def _complete(names: Set[FieldName]) -> bool:
    begun = {row.optional for row in STATE_TABLE if row.name in names}
    return names == {row.name for row in STATE_TABLE if row.optional is None or row.optional in begun}


def _fields(
    description: dict[str, Any], values: dict[FieldName, Tensor], coded: dict[FieldName, memoryview]
) -> dict[FieldName, Tensor]:
    if description["codec"] != "compact":
        if coded:
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
        sound=sound_format(description.get("sound")),
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
