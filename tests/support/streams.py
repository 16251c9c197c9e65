# SPDX-License-Identifier: Apache-2.0
"""Small streams that several tests look at."""

from collections.abc import Sequence
from dataclasses import replace

import torch

from structgstream.cameras import Similarity
from structgstream.codec.fields.packet_fields import FREE_FIELDS, dequantize_state, quantize_state
from structgstream.codec.fields.quantization import round_to_bins
from structgstream.codec.fields.static_fields import UNCODED_FIELDS
from structgstream.codec.packets import PacketKind, PacketSink, StreamHeader
from structgstream.codec.scene_coder import SceneEncoder
from structgstream.codec.sinks import MemorySink
from structgstream.scene.scene import Scene
from structgstream.scene.state import PAPER_DYNAMIC, STATE_TABLE, FieldName, parameters_of, scene_of, state_of
from tests.support.rigs import arc_rig, random_scene


def header_for(scene: Scene, *, dynamic: frozenset[FieldName] = PAPER_DYNAMIC) -> StreamHeader:
    """The header of a stream that begins with ``scene``, taken by as many training cameras as it has colour rows."""
    return StreamHeader(
        rig=arc_rig(scene.camera_color.gains.shape[0] + 1),
        similarity=Similarity((0.1, -0.25, 3.0), 0.7),
        fps=30.0,
        codec="raw",
        dynamic=dynamic,
        static={name: value for name, value in state_of(scene).items() if name not in dynamic},
        distance_input=scene.distance_input,
        config={"seed": 0},
        metadata={"capture": "test"},
    )


STEPS: dict[str, float] = {p.name: 2.0**-6 for row in STATE_TABLE for p in row.parameters if p.step}
STATIC_STEP = 2.0**-7


def compact_header(scene: Scene, *, dynamic: frozenset[FieldName] = PAPER_DYNAMIC) -> StreamHeader:
    """As :func:`header_for`, with codec ``compact``; ``scene`` is the reference."""
    rows = dynamic - FREE_FIELDS
    used = {p.name: STEPS[p.name] for p in parameters_of(dynamic) if p.name in STEPS}
    state = state_of(scene)
    reference = dequantize_state(quantize_state(state, rows, used), rows, used)
    init_steps: dict[FieldName, float] = {
        name: used.get(name, STATIC_STEP) for name in state if name not in UNCODED_FIELDS
    }
    header = header_for(scene, dynamic=dynamic)
    static = round_to_bins(header.static, init_steps)
    return replace(header, codec="compact", static=static, steps=used, reference=reference, init_steps=init_steps)


def small_scene(anchors: int = 3, *, free: int = 0, seed: int = 0) -> Scene:
    """A scene of a few hundred bytes: two features, two Gaussians an anchor, MLPs of three hidden units."""
    g = torch.Generator().manual_seed(seed)
    k, features, hidden = 2, 2, 3
    inputs = features + 4

    def head(outputs: int) -> torch.Tensor:
        return torch.randn(hidden * (inputs + 1) + outputs * (hidden + 1), generator=g)

    state: dict[FieldName, torch.Tensor] = {
        "anchor_positions": torch.randn(anchors, 3, generator=g),
        "offset_scales": torch.randn(anchors, 3, generator=g),
        "base_scales": torch.randn(anchors, 3, generator=g),
        "anchor_offsets": torch.randn(anchors, k, 3, generator=g),
        "anchor_features": torch.randn(anchors, features, generator=g),
        "opacity_mlp": head(k),
        "color_mlp": head(3 * k),
        "covariance_mlp": head(7 * k),
        "free": torch.randn(free, 14, generator=g),
        "free_births": torch.arange(free, dtype=torch.int64) + 2**40,
        "camera_color": torch.randn(2, 6, generator=g),
    }
    return scene_of(state, distance_input=True)


def moved(scene: Scene, step: int) -> Scene:
    """``scene`` with its dynamic parts a little further."""
    anchors = replace(scene.anchors, positions=scene.anchors.positions + 0.01 * step)
    return replace(scene, anchors=anchors, free=random_scene(0, free=step).free)


def write_stream(sink: PacketSink, scenes: Sequence[Scene], *, header: StreamHeader | None = None) -> list[Scene]:
    """``scenes`` as a whole stream, a key packet at every third; returns what the encoder says a reader will see."""
    header = header or header_for(scenes[0])
    encoder = SceneEncoder(header)
    seen = []
    sink.open(header)
    for i, scene in enumerate(scenes):
        kind = PacketKind.KEY if i % 3 == 0 else PacketKind.DELTA
        encoded = encoder.encode(scene, index=i, pts_seconds=i / 30.0, kind=kind)
        sink.write(encoded.packet)
        seen.append(encoded.reconstruction)
    sink.close()
    return seen


def small_stream(frames: int = 4) -> bytes:
    """A complete stream of a few kilobytes."""
    sink = MemorySink()
    write_stream(sink, [moved(small_scene(), i) for i in range(frames)])
    return sink.data


def flipped(data: bytes, *bits: int) -> bytes:
    """``data`` with these bits changed, by number from the lowest of the first byte."""
    mangled = bytearray(data)
    for bit in bits:
        mangled[bit // 8] ^= 1 << bit % 8
    return bytes(mangled)


def same(a: Scene, b: Scene) -> bool:
    """Whether two scenes are equal bit for bit, NaN included."""
    one, other = state_of(a), state_of(b)
    bits = {name: (value.dtype, value.shape, value.numpy().tobytes()) for name, value in one.items()}
    return bits == {name: (value.dtype, value.shape, value.numpy().tobytes()) for name, value in other.items()}
