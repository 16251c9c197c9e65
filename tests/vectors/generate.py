# SPDX-License-Identifier: Apache-2.0
"""Makes the golden stream of format version 1 and what a decoder must find in it.

Every number is a small multiple of a power of two: exact in float32, in JSON, and on any machine. Run from the
repository's root, only when a new version of the format gets vectors of its own: ``python tests/vectors/generate.py``.
"""

import hashlib
import json
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from structgstream.cameras import Camera, CameraRig
from structgstream.codec.encoder import SceneEncoder
from structgstream.codec.packets import PacketKind, StreamHeader
from structgstream.codec.sinks import MemorySink
from structgstream.scene.scene import Scene
from structgstream.scene.state import PAPER_DYNAMIC, FieldName, scene_of, state_of
from structgstream.similarity import Similarity

FOLDER = Path(__file__).parent
STREAM, EXPECTED, SUMS = (FOLDER / name for name in ("version-1.sgs", "version-1.json", "SHA256SUMS"))
ANCHORS, K, FEATURES, HIDDEN = 3, 2, 2, 3
KINDS = (PacketKind.KEY, PacketKind.DELTA, PacketKind.KEY)


def numbers(*shape: int, salt: int) -> Tensor:
    """Sixteenths between -4 and 4 that look arbitrary."""
    count = int(torch.tensor(shape).prod())
    return ((torch.arange(count) * 37 + salt * 53) % 129 - 64).float().reshape(shape) / 16


def golden_scene(frame: int) -> Scene:
    """Frame 0 has no free Gaussians, frame 1 two, frame 2 one of them and a new one."""
    inputs = FEATURES + 4
    births = torch.tensor([[], [5, 2**40], [5, 2**40 + 1]][frame], dtype=torch.int64)
    sizes = {
        name: HIDDEN * (inputs + 1) + n * K * (HIDDEN + 1) for name, n in (("opacity", 1), ("color", 3), ("cov", 7))
    }
    state: dict[FieldName, Tensor] = {
        "anchor_positions": numbers(ANCHORS, 3, salt=1 + 100 * frame),
        "offset_scales": numbers(ANCHORS, 3, salt=2 + 100 * frame),
        "base_scales": numbers(ANCHORS, 3, salt=3),
        "anchor_offsets": numbers(ANCHORS, K, 3, salt=4),
        "anchor_features": numbers(ANCHORS, FEATURES, salt=5),
        "opacity_mlp": numbers(sizes["opacity"], salt=6),
        "color_mlp": numbers(sizes["color"], salt=7),
        "covariance_mlp": numbers(sizes["cov"], salt=8 + 100 * frame),
        "free": numbers(len(births), 14, salt=9 + 100 * frame),
        "free_births": births,
        "camera_color": numbers(2, 6, salt=11),
    }
    return scene_of(state, distance_input=True)


def golden_header() -> StreamHeader:
    """Three cameras on a line, the middle one held out."""
    cameras = {}
    for i, name in enumerate(("left", "middle", "right")):
        viewmat = torch.eye(4, dtype=torch.float64)
        viewmat[0, 3], viewmat[2, 3] = 1.0 - i, 4.5
        K_matrix = torch.tensor([[40.0, 0, 24], [0, 40.25, 16], [0, 0, 1]], dtype=torch.float64)
        cameras[name] = Camera(viewmat, K_matrix, 48, 32, near=0.125)
    return StreamHeader(
        rig=CameraRig(cameras, frozenset({"middle"})),
        similarity=Similarity((0.25, -0.5, 3.0), 0.75),
        fps=30.0,
        codec="raw",
        dynamic=PAPER_DYNAMIC,
        static={name: value for name, value in state_of(golden_scene(0)).items() if name not in PAPER_DYNAMIC},
        distance_input=True,
        config={"seed": 7, "online": {"iterations": 10}},
        metadata={"capture": "golden", "note": "ä"},
    )


def golden_stream() -> bytes:
    """The whole stream as today's encoder writes it."""
    header = golden_header()
    encoder, sink = SceneEncoder(header), MemorySink()
    sink.open(header)
    for index, kind in enumerate(KINDS):
        sink.write(encoder.encode(golden_scene(index), index=index, pts_seconds=index / 4, kind=kind).packet)
    sink.close()
    return sink.data


def expected() -> dict[str, Any]:
    """What is in it, as plain values: tensors as shape and flat list, in the order of the state table."""
    frames = []
    for index, kind in enumerate(KINDS):
        fields = {
            name: {"shape": list(value.shape), "values": value.flatten().tolist()}
            for name, value in state_of(golden_scene(index)).items()
        }
        frames.append({"index": index, "pts_seconds": index / 4, "kind": kind.name, "fields": fields})
    return {"frames": frames}


if __name__ == "__main__":
    STREAM.write_bytes(golden_stream())
    EXPECTED.write_text(json.dumps(expected(), indent=None) + "\n")
    SUMS.write_text("".join(f"{hashlib.sha256(f.read_bytes()).hexdigest()}  {f.name}\n" for f in (STREAM, EXPECTED)))
