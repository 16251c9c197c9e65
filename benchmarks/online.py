# SPDX-License-Identifier: Apache-2.0
"""A whole online frame of the paper's method, patching included, on a wall of which a part has moved.

It starts from the true scene of the frame before; quality is told at a camera that training does not see, beside the
quality without any fit.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Literal

import torch

from benchmarks.benchmark import Benchmark, Growth, Target, Variant
from benchmarks.contenders import torch_but_raster
from benchmarks.contest import Contestant, Quantity, Results
from benchmarks.world import World, held_out_psnr, wall_world
from structgstream.kernels.backend import Backend, cpu_backend
from structgstream.presets import PAPER
from structgstream.training.online import OnlineConfig, fit_next_frame
from structgstream.training.result import FitResult

NOISE = 1.0  # Levels of 255: what a good camera leaves after denoising.
Against = Literal["torch", "everything", "nobody"]
"""What stands first: torch for all but the raster, the same frame with everything moving, or nothing (for growth)."""


def _world(share: float, *, anchors: int, width: int, height: int, cameras: int) -> World:
    return wall_world(
        cpu_backend(), anchors=anchors, width=width, height=height, cameras=cameras, share=share, noise=NOISE
    )


def paper_config(iterations: int) -> OnlineConfig:
    """The paper's online frame, patching in the middle of ``iterations`` iterations (paper: 100)."""
    patching = replace(PAPER.online.patching, iteration=iterations // 2)
    return replace(PAPER.online, iterations=iterations, patching=patching)


def _fitting(
    name: str, world: World, backend: Backend, config: OnlineConfig, *, threads: int, compared: bool = True
) -> Contestant:
    """``compared``: whether others fit the same pictures, so that the quality must be the same."""
    fits: list[FitResult] = []

    def run() -> Results:
        fit = fit_next_frame(world.before, world.frame, world.rig, config=config, backend=backend, seed=0)
        fits[:] = [fit]
        quality = held_out_psnr(fit.scene, world, cpu_backend())
        return [torch.tensor(fit.train_psnr), torch.tensor(quality)] if compared else [None, None]

    def facts() -> Mapping[str, float]:
        return {
            "held-out psnr": held_out_psnr(fits[0].scene, world, cpu_backend()),
            "held-out without a fit psnr": held_out_psnr(world.before, world, cpu_backend()),
            "train psnr": fits[0].train_psnr,
            "free Gaussians": float(len(fits[0].scene.free)),
        }

    return Contestant(name, run, threads, facts=facts)


def contestants(
    *, share: float, against: Against, anchors: int, width: int, height: int, cameras: int, iterations: int
) -> list[Contestant]:
    """An online frame in which ``share`` of the area has moved, and what it is held against."""
    config = paper_config(iterations)
    world = _world(share, anchors=anchors, width=width, height=height, cameras=cameras)
    if against == "nobody":
        return [_fitting("cpu, 2 threads", world, cpu_backend(), config, threads=2)]
    if against == "torch":
        return [
            _fitting("torch but the raster, 2 threads", world, torch_but_raster(), config, threads=2),
            _fitting("cpu, 1 thread", world, cpu_backend(), config, threads=1),
            _fitting("cpu, 2 threads", world, cpu_backend(), config, threads=2),
        ]
    everything = _world(1.0, anchors=anchors, width=width, height=height, cameras=cameras)
    return [
        _fitting("everything moves, cpu, 2 threads", everything, cpu_backend(), config, threads=2, compared=False),
        _fitting(f"{100 * share:g} % moves, cpu, 2 threads", world, cpu_backend(), config, threads=2, compared=False),
    ]


def _sizes(share: float, against: Against) -> dict[str, object]:
    sizes = {"anchors": 12_000, "width": 320, "height": 240, "cameras": 8, "iterations": 100}
    return {"share": share, "against": against, **sizes}


def _quick(share: float, against: Against) -> dict[str, object]:
    sizes = {"anchors": 60, "width": 48, "height": 36, "cameras": 3, "iterations": 6}
    return {"share": share, "against": against, **sizes}


BENCHMARK = Benchmark(
    name="online",
    work="an online frame of 100 iterations",
    contestants=contestants,
    # Rounding decides which Gaussians patching chooses and, with Adam's tiny epsilon, whole steps of some anchors: two
    # fits of equal quality differ by about a tenth of a decibel.
    quantities=[Quantity("train PSNR", 0.1, "largest"), Quantity("held-out PSNR", 0.4, "largest")],
    variants=[
        Variant("everything moves; 12,000 anchors, 320x240, 8 cameras", _sizes(1.0, "torch"), _quick(1.0, "torch")),
        Variant(
            "5 % of the area moves or everything; 12,000 anchors, 320x240, 8 cameras",
            _sizes(0.05, "everything"),
            _quick(0.05, "everything"),
        ),
    ],
    growth=[
        Growth(
            "moving share, % of the area",
            {100 * share: _sizes(share, "nobody") for share in (0.05, 0.1, 0.2, 0.4, 0.8, 1.0)},
            {100 * share: _quick(share, "nobody") for share in (0.5, 1.0)},
        )
    ],
    targets=[Target("5 % moves, cpu, 2 threads", at_least_times=2.0)],
)
