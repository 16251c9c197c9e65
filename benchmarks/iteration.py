# SPDX-License-Identifier: Apache-2.0
"""A whole training iteration of an online frame as the paper has it, all native and native in the rasteriser only.

It is the package's own ``fit_next_frame`` with fewer iterations; view-space gradients are collected in one half of
them, as in the paper, and patching, once a frame, is left out. Setting up the frame is divided among them.
"""

import time
from collections.abc import Callable, Mapping
from dataclasses import replace

import torch

from benchmarks.benchmark import PICTURES, Benchmark, Growth, Target, Variant
from benchmarks.contenders import contenders
from benchmarks.contest import Contestant, Quantity, Results
from benchmarks.stages import staged
from benchmarks.world import World, wall_world
from structgstream.kernels.backend import Backend, cpu_backend
from structgstream.session.presets import PAPER
from structgstream.training.online.config import OnlineConfig
from structgstream.training.online.fit import fit_next_frame

STAGE_NAMES = {"rasterize": "raster", "l1_ssim": "ssim", "generate_structured": "decode", "adam_step": "optimise"}


def paper_config(iterations: int) -> OnlineConfig:
    """The paper's online frame with ``iterations`` iterations and no patching."""
    config = PAPER.online
    patching = replace(config.patching, collect_from=iterations // 2, iteration=iterations + 1)
    return replace(config, iterations=iterations, patching=patching)


def _fitting(world: World, backend: Backend, iterations: int) -> Callable[[], Results]:
    config = paper_config(iterations)

    def run() -> Results:
        fit = fit_next_frame(world.before, world.frame, world.rig, config=config, backend=backend, seed=0)
        moved = fit.scene.anchors.positions - world.before.anchors.positions
        return [torch.tensor(fit.train_psnr), moved]

    return run


def _shares(world: World, backend: Backend, iterations: int, threads: int) -> Callable[[], Mapping[str, float]]:
    """Seconds of each operation and their shares of an iteration, from one more fit with timed operations."""

    def facts() -> Mapping[str, float]:
        torch.set_num_threads(threads)
        seconds: dict[str, float] = {}
        run = _fitting(world, staged(backend, seconds), iterations)
        started = time.perf_counter()
        run()
        total = time.perf_counter() - started
        seconds["rest"] = total - sum(seconds.values())
        found = {}
        for name, value in seconds.items():
            stage = STAGE_NAMES.get(name, name)
            found[f"{stage}_seconds"] = value / iterations
            found[f"{stage}_share"] = value / total
        return found

    return facts


def contestants(*, iterations: int, **sizes: int) -> list[Contestant]:
    """The back-ends of whole fits; ``sizes`` of the world."""
    world = wall_world(cpu_backend(), **sizes)
    return [
        Contestant(
            name,
            _fitting(world, backend, iterations),
            threads,
            units=iterations,
            facts=_shares(world, backend, iterations, threads),
        )
        for name, backend, threads in contenders()
    ]


def _sizes(anchors: int = 20_000, width: int = 480, height: int = 360, cameras: int = 8) -> dict[str, int]:
    return {"anchors": anchors, "width": width, "height": height, "cameras": cameras, "iterations": 16}


def _quick(anchors: int = 60, width: int = 48, height: int = 36, cameras: int = 3) -> dict[str, int]:
    return {"anchors": anchors, "width": width, "height": height, "cameras": cameras, "iterations": 4}


NATIVE = ("cpu, 2 threads",)

BENCHMARK = Benchmark(
    name="iteration",
    work="one online training iteration as in the paper (k = 5)",
    contestants=contestants,
    quantities=[
        Quantity("train PSNR", 0.02, "largest"),
        # Adam with the paper's tiny epsilon turns rounding of the smallest gradients into whole steps of some anchors.
        Quantity("anchors' motion", 0.05),
    ],
    variants=[Variant("20,000 anchors, 480x360, 8 cameras", _sizes(), _quick())],
    growth=[
        Growth(
            "anchors",
            {n: _sizes(anchors=n) for n in (2_500, 5_000, 10_000, 20_000, 40_000, 80_000)},
            {n: _quick(anchors=n) for n in (30, 60)},
            only=NATIVE,
        ),
        Growth(
            "pixels (20,000 anchors)",
            {w * h: _sizes(width=w, height=h) for w, h in PICTURES},
            {w * h: _quick(width=w, height=h) for w, h in ((32, 24), (48, 36))},
            only=NATIVE,
        ),
        Growth(
            "cameras",
            {n: _sizes(cameras=n) for n in (4, 8, 16, 32)},
            {n: _quick(cameras=n) for n in (2, 4)},
            only=NATIVE,
        ),
    ],
    targets=[Target("cpu, 2 threads", at_least_times=3.0), Target("cpu, 2 threads", at_most_seconds=0.060)],
)
