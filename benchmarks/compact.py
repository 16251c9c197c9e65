# SPDX-License-Identifier: Apache-2.0
"""A delta packet of the compact codec: encoding and decoding, compared with the same frame as float32."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from benchmarks.benchmark import Benchmark, Growth, Target, Variant
from benchmarks.contest import Contestant, Quantity, Results
from structgstream.cameras import Camera, CameraRig, Similarity
from structgstream.codec.container.blocks import pack_raw_block, unpack_blocks
from structgstream.codec.fields.packet_fields import dequantize_state, quantize_state
from structgstream.codec.packets import PacketKind, StreamHeader
from structgstream.codec.scene_coder import CompactCoder, CompactState
from structgstream.scene.order import morton_order
from structgstream.scene.state import FieldName

STEPS = {
    "anchor_positions": 1 / 512,
    "offset_scales": 1 / 64,
    "free_means": 1 / 512,
    "free_log_scales": 1 / 16,
    "free_quats": 1 / 64,
    "free_logit_opacities": 1 / 8,
    "free_colors": 1 / 128,
}
DYNAMIC: frozenset[FieldName] = frozenset({"anchor_positions", "offset_scales", "free", "free_births"})
ROWS: frozenset[FieldName] = frozenset({"anchor_positions", "offset_scales"})
State = Mapping[FieldName, Tensor]


@dataclass(frozen=True)
class Work:
    """One delta packet, and what comes before it."""

    header: StreamHeader
    before: CompactState
    frame: State
    raw: bytes
    coded: dict[FieldName, bytes]


def workload(anchors: int) -> Work:
    """Frame 2 of a stream: 5 % of the anchors move, in 40 balls; there are 5 % as many free Gaussians."""
    g = torch.Generator().manual_seed(3)
    positions = torch.randn(anchors, 3, generator=g)
    positions = positions[morton_order(positions)]
    centers = positions[torch.randint(anchors, (40,), generator=g)]
    nearest = torch.cdist(positions, centers).min(1).values
    active = nearest <= nearest.kthvalue(max(anchors // 20, 1)).values
    free = anchors // 20
    state: State = {
        "anchor_positions": positions,
        "offset_scales": torch.randn(anchors, 3, generator=g) * 0.3 - 2.0,
        "free": torch.randn(free, 14, generator=g) * 0.3,
        "free_births": torch.arange(free),
    }
    rig = CameraRig({name: Camera(torch.eye(4).double(), torch.eye(3).double(), 8, 8, near=0.1) for name in "ab"})
    header = StreamHeader(
        rig=rig,
        similarity=Similarity((0.0, 0.0, 0.0), 1.0),
        fps=30.0,
        codec="compact",
        dynamic=DYNAMIC,
        static={},
        distance_input=True,
        config={},
        metadata={},
        steps=STEPS,
        reference=_rounded(state, ROWS),
    )
    encoder = CompactCoder(header)
    encoder.encode(state, kind=PacketKind.KEY, index=0)
    state = _moved(state, active, 1, g)
    encoder.encode(state, kind=PacketKind.DELTA, index=1)
    before = encoder.state
    assert before is not None
    state = _moved(state, active, 2, g)
    coded = encoder.encode(state, kind=PacketKind.DELTA, index=2)
    seen = _rounded(state, DYNAMIC)
    raw = b"".join(pack_raw_block(name, seen[name]) for name in sorted(DYNAMIC))
    return Work(header, before, state, raw, coded)


def _moved(state: State, active: Tensor, frame: int, g: torch.Generator) -> State:
    """A step of about a bin in the active rows, which are nearly the same from frame to frame."""
    now = active & (torch.rand(len(active), generator=g) < 0.95)

    def step(count: int, *, size: float) -> Tensor:
        return torch.randn(count, 3, generator=g) * size

    count, free = len(active), len(state["free"])
    spawned = max(free * 3 // 100, 1)
    changed = (torch.rand(free, 1, generator=g) < 0.2) & (torch.rand(free, 14, generator=g) < 0.7)
    moved = state["free"] + changed * torch.randn(free, 14, generator=g) * 0.02
    return {
        "anchor_positions": state["anchor_positions"] + now[:, None] * step(count, size=1.5 / 512),
        "offset_scales": state["offset_scales"] + now[:, None] * step(count, size=0.7 / 64),
        "free": torch.cat([moved, torch.randn(spawned, 14, generator=g) * 0.3]),
        "free_births": torch.cat([state["free_births"], frame * 2**32 + torch.arange(spawned)]),
    }


def _rounded(state: State, names: frozenset[FieldName]) -> State:
    """The fields ``names`` as a decoder has them."""
    return dequantize_state(quantize_state(state, names, STEPS), names, STEPS)


def _values(state: State) -> Results:
    return [state[name] for name in sorted(DYNAMIC)]


def contestants(*, anchors: int) -> list[Contestant]:
    """Reading float32, decoding, encoding: all three end with the same numbers."""
    work = workload(anchors)
    encoder, decoder = CompactCoder(work.header), CompactCoder(work.header)
    sizes = {"raw": float(len(work.raw)), "compact": float(sum(map(len, work.coded.values())))}

    def decode() -> Results:
        decoder.state = work.before
        return _values(decoder.decode(work.coded, kind=PacketKind.DELTA, index=2))

    def encode() -> Results:
        encoder.state = work.before
        encoder.encode(work.frame, kind=PacketKind.DELTA, index=2)
        return _values(_rounded(work.frame, DYNAMIC))

    def facts(name: str) -> Callable[[], Mapping[str, float]]:
        return lambda: {"bytes": sizes[name]}

    return [
        Contestant(
            "raw, decode, 1 thread",
            lambda: _values(unpack_blocks(work.raw, 0, where="The frame")[0]),
            1,
            facts=facts("raw"),
        ),
        Contestant("compact, decode, 1 thread", decode, 1, facts=facts("compact")),
        Contestant("compact, encode, 1 thread", encode, 1, facts=facts("compact")),
    ]


BENCHMARK = Benchmark(
    name="compact",
    work="a delta packet of 100,000 anchors, of which 5 % move, and 5,000 free Gaussians, of which 1,000 change, "
    "with 150 spawned (sizes are reported too)",
    contestants=contestants,
    quantities=[Quantity(name, 0.0, "largest") for name in sorted(DYNAMIC)],
    variants=[Variant("100,000 anchors", {"anchors": 100_000}, {"anchors": 2_000})],
    growth=[
        Growth(
            "anchors",
            {n: {"anchors": n} for n in (12_500, 25_000, 50_000, 100_000, 200_000)},
            {n: {"anchors": n} for n in (500, 1_000)},
        )
    ],
    targets=[Target("compact, decode, 1 thread", at_most_seconds=0.033)],
)
