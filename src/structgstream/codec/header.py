# SPDX-License-Identifier: Apache-2.0
"""The init record: what a receiver knows before the first frame (docs/bitstream.md, section Init record)."""

import json
import struct
from typing import Any

import torch
import zstandard

from structgstream.cameras import Camera, CameraRig
from structgstream.codec.blocks import packed_block, unpacked_blocks
from structgstream.codec.packets import StreamHeader
from structgstream.errors import CalibrationError, StreamError
from structgstream.scene.state import STATE_TABLE
from structgstream.similarity import Similarity

MAX_JSON_BYTES = 16 * 2**20
LENGTH = struct.Struct("<I")
_ZSTD_LEVEL = 19


def packed_header(header: StreamHeader) -> bytes:
    """The payload of an init record."""
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
    }
    text = json.dumps(description, sort_keys=True, allow_nan=False, separators=(",", ":")).encode()
    packed = zstandard.ZstdCompressor(level=_ZSTD_LEVEL).compress(text)
    static = [packed_block(f.name, header.static[f.name]) for f in STATE_TABLE if f.name not in header.dynamic]
    return LENGTH.pack(len(packed)) + packed + b"".join(static)


def unpacked_header(payload: bytes) -> StreamHeader:
    """The header of an init record's payload.

    Raises:
        StreamError: the payload contradicts the format.
    """
    if len(payload) < LENGTH.size:
        raise StreamError("The init record is too short.")
    (length,) = LENGTH.unpack_from(payload)
    if LENGTH.size + length > len(payload):
        raise StreamError("The init record states a longer description than it holds.")
    try:
        packed = payload[LENGTH.size : LENGTH.size + length]
        text = zstandard.ZstdDecompressor().decompress(packed, max_output_size=MAX_JSON_BYTES)
        description: dict[str, Any] = json.loads(text)
        static, _ = unpacked_blocks(payload, LENGTH.size + length, where="The init record")
        cameras = {
            entry["name"]: Camera(
                viewmat=torch.tensor(entry["viewmat"], dtype=torch.float64).reshape(4, 4),
                K=torch.tensor(entry["K"], dtype=torch.float64).reshape(3, 3),
                width=entry["width"],
                height=entry["height"],
                near=entry["near"],
            )
            for entry in description["cameras"]
        }
        held_out = frozenset(entry["name"] for entry in description["cameras"] if entry["held_out"])
        center = description["similarity"]["center"]
        return StreamHeader(
            rig=CameraRig(cameras, held_out),
            similarity=Similarity((center[0], center[1], center[2]), description["similarity"]["scale"]),
            fps=description["fps"],
            codec=description["codec"],
            dynamic=frozenset(description["dynamic"]),
            static=static,
            distance_input=description["distance_input"],
            config=description["config"],
            metadata=description["metadata"],
        )
    except (ValueError, KeyError, TypeError, RuntimeError, zstandard.ZstdError, CalibrationError) as error:
        raise StreamError(f"The init record does not follow the format ({error}).") from error
