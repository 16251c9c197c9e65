# SPDX-License-Identifier: Apache-2.0
"""A viewer's frame: a packet is decoded to a scene, which a held-out camera draws."""

from collections.abc import Callable
from dataclasses import replace

import torch

from benchmarks.benchmark import PICTURES, Benchmark, Growth, Variant
from benchmarks.contest import Contestant, Quantity, Results
from benchmarks.world import HELD_OUT, moved, wall_rig, wall_scene
from structgstream.cameras import Similarity
from structgstream.codec.packets import Packet, PacketKind, StreamHeader
from structgstream.codec.scene_coder import SceneDecoder, SceneEncoder
from structgstream.kernels.backend import Backend, cpu_backend, reference_backend
from structgstream.scene.free import FreeGaussians
from structgstream.scene.render import render
from structgstream.scene.scene import Scene
from structgstream.scene.state import PAPER_DYNAMIC, state_of

FRAMES = 4
SHIFT = (0.004, 0.002, 0.0)


def _with_free(scene: Scene, count: int) -> Scene:
    """The wall with ``count`` free Gaussians before it, as patching leaves some."""
    g = torch.Generator().manual_seed(3)
    free = FreeGaussians(
        means=torch.rand(count, 3, generator=g) * torch.tensor([2.0, 1.5, -0.2]) - torch.tensor([1.0, 0.75, 0.1]),
        log_scales=torch.full((count, 3), -4.5),
        quats=torch.randn(count, 4, generator=g),
        logit_opacities=torch.randn(count, generator=g),
        colors=torch.rand(count, 3, generator=g),
        births=torch.arange(count),
    )
    return replace(scene, free=free)


def stream(anchors: int, *, width: int, height: int) -> tuple[StreamHeader, list[Packet]]:
    """A header and the packets of a few frames in which the whole wall drifts."""
    rig = wall_rig(2, width=width, height=height)
    scene = _with_free(wall_scene(anchors, cameras=2), anchors // 20)
    header = StreamHeader(
        rig=rig,
        similarity=Similarity(),
        fps=30.0,
        codec="raw",
        dynamic=PAPER_DYNAMIC,
        static={name: value for name, value in state_of(scene).items() if name not in PAPER_DYNAMIC},
        distance_input=True,
        config={},
        metadata={},
    )
    encoder, packets = SceneEncoder(header), []
    for index in range(FRAMES):
        kind = PacketKind.DELTA if index else PacketKind.KEY
        packets.append(encoder.encode(scene, index=index, pts_seconds=index / 30.0, kind=kind).packet)
        scene = moved(scene, share=1.0, shift=SHIFT)
    return header, packets


def _viewing(header: StreamHeader, packets: list[Packet], backend: Backend) -> Callable[[], Results]:
    def run() -> Results:
        decoder, camera = SceneDecoder(header), header.rig[HELD_OUT]
        return [render(decoder.decode(packet), camera, backend).image for packet in packets]

    return run


def contestants(*, anchors: int, width: int, height: int) -> list[Contestant]:
    """The torch reference first, then the C++ with one and with two threads."""
    header, packets = stream(anchors, width=width, height=height)
    return [
        Contestant(name, _viewing(header, packets, backend), threads, units=FRAMES)
        for name, backend, threads in (
            ("torch reference, 2 threads", reference_backend(), 2),
            ("cpu, 1 thread", cpu_backend(), 1),
            ("cpu, 2 threads", cpu_backend(), 2),
        )
    ]


def _sizes(anchors: int = 20_000, width: int = 480, height: int = 360) -> dict[str, int]:
    return {"anchors": anchors, "width": width, "height": height}


NATIVE = ("cpu, 2 threads",)

BENCHMARK = Benchmark(
    name="render",
    work="decoding a frame's packet and drawing it for a held-out camera",
    contestants=contestants,
    # Splats of one depth may be blended in either order; the median pixel is not among them.
    quantities=[Quantity(f"picture {index}", 1e-4, "median") for index in range(FRAMES)],
    variants=[Variant("20,000 anchors, 1,000 free Gaussians, 480x360", _sizes(), _sizes(60, 48, 36))],
    growth=[
        Growth(
            "anchors",
            {n: _sizes(anchors=n) for n in (2_500, 5_000, 10_000, 20_000, 40_000, 80_000)},
            {n: _sizes(n, 48, 36) for n in (30, 60)},
            only=NATIVE,
        ),
        Growth(
            "pixels (20,000 anchors)",
            {w * h: _sizes(width=w, height=h) for w, h in PICTURES},
            {w * h: _sizes(60, w, h) for w, h in ((32, 24), (48, 36))},
            only=NATIVE,
        ),
    ],
    per_second="frames a second",
)
