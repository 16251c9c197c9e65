# SPDX-License-Identifier: Apache-2.0
"""A whole online frame of the paper's method, patching included, on a wall of which a part has moved.

It starts from the true scene of the frame before; quality is measured at a held-out camera, and compared with the
quality without any fit. Following motion is as in the preset ``motion``.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Literal

import torch

from benchmarks.benchmark import Benchmark, Growth, Target, Variant
from benchmarks.contenders import contenders
from benchmarks.contest import Contestant, Quantity, Results
from benchmarks.world import World, fitted, held_out_psnr, wall_world
from structgstream.kernels.backend import Backend, cpu_backend
from structgstream.session.presets import MOTION, PAPER
from structgstream.training.online.config import MotionConfig, OnlineConfig
from structgstream.training.result import FitResult

NOISE = 1.0  # Levels of 255: what a good camera leaves after denoising.
Contest = Literal["back-ends", "shares", "pictures", "growth"]
"""``back-ends``: the paper's method, torch for all but the raster and all native. ``shares``: a frame in which all
moves and one in which little does, following motion or not. ``pictures``: following motion, drawn whole or where it
shows. ``growth``: following motion or not."""


def paper_config(iterations: int) -> OnlineConfig:
    """The paper's online frame, patching in the middle of ``iterations`` iterations (paper: 100)."""
    patching = replace(PAPER.online.patching, iteration=iterations // 2)
    return replace(PAPER.online, iterations=iterations, patching=patching)


def motion_config(iterations: int) -> OnlineConfig:
    """The same, fitting only what moves, with the fields that the preset ``motion`` trains."""
    config = paper_config(iterations)
    return replace(config, dynamic=MOTION.online.dynamic, motion=MOTION.online.motion)


def _fitting(
    name: str, world: World, backend: Backend, config: OnlineConfig, *, threads: int = 2, compared: bool = True
) -> Contestant:
    """``compared``: whether others fit the same pictures, so that the quality must be the same."""
    fits: list[FitResult] = []

    def run() -> Results:
        fits[:] = [fitted(world, backend, config)]
        quality = held_out_psnr(fits[0].scene, world, cpu_backend())
        return [torch.tensor(quality)] if compared else [None]

    def facts() -> Mapping[str, float]:
        return {
            "held-out psnr": held_out_psnr(fits[0].scene, world, cpu_backend()),
            "held-out without a fit psnr": held_out_psnr(world.before, world, cpu_backend()),
            "free Gaussians": float(len(fits[0].scene.free)),
        }

    return Contestant(name, run, threads, facts=facts)


def contestants(
    *, contest: Contest, share: float, anchors: int, width: int, height: int, cameras: int, iterations: int
) -> list[Contestant]:
    """An online frame in which ``share`` of the area has moved, and what it is held against."""
    native, paper, motion = cpu_backend(), paper_config(iterations), motion_config(iterations)
    everything = replace(motion, motion=replace(motion.motion, enabled=False))

    def world(moving: float) -> World:
        sizes = {"anchors": anchors, "width": width, "height": height, "cameras": cameras}
        return wall_world(native, **sizes, share=moving, noise=NOISE)

    here = world(share)
    if contest == "back-ends":
        return [_fitting(name, here, backend, paper, threads=threads) for name, backend, threads in contenders()]
    if contest == "shares":
        return [
            _fitting("everything moves, following motion", world(1.0), native, motion, compared=False),
            _fitting("a part moves, following motion", here, native, motion, compared=False),
            _fitting("a part moves, everything fitted", here, native, everything, compared=False),
        ]
    if contest == "pictures":

        class WholePictures(MotionConfig):
            MARGIN_PIXELS = max(width, height)  # reaches all tiles

        whole = replace(motion, motion=WholePictures(**vars(motion.motion)))
        return [
            _fitting("following motion, whole pictures", here, native, whole),
            _fitting("following motion", here, native, motion),
        ]
    return [
        _fitting("everything fitted", here, native, everything, compared=False),
        _fitting("following motion", here, native, motion, compared=False),
    ]


def _sizes(contest: Contest, share: float) -> dict[str, object]:
    sizes = {"anchors": 12_000, "width": 320, "height": 240, "cameras": 8, "iterations": 100}
    return {"contest": contest, "share": share, **sizes}


def _quick(contest: Contest, share: float) -> dict[str, object]:
    sizes = {"anchors": 60, "width": 48, "height": 36, "cameras": 3, "iterations": 6}
    return {"contest": contest, "share": share, **sizes}


WORLD = "12,000 anchors, 320x240, 8 cameras"

BENCHMARK = Benchmark(
    name="online",
    work="an online frame of 100 iterations",
    contestants=contestants,
    # Rounding decides which Gaussians patching chooses and, with Adam's tiny epsilon, whole steps of some anchors: two
    # fits of equal quality differ by about a tenth of a decibel.
    quantities=[Quantity("held-out PSNR", 0.4, "largest")],
    variants=[
        Variant(f"the paper's method, everything moves; {WORLD}", _sizes("back-ends", 1.0), _quick("back-ends", 1.0)),
        Variant(
            f"5 % of the area moves, or everything, with the same fields trained; {WORLD}",
            _sizes("shares", 0.05),
            _quick("shares", 0.3),
        ),
        Variant(f"5 % of the area moves; {WORLD}", _sizes("pictures", 0.05), _quick("pictures", 0.3)),
    ],
    growth=[
        Growth(
            "moving share, % of the area",
            {100 * share: _sizes("growth", share) for share in (0.05, 0.1, 0.2, 0.4, 0.8, 1.0)},
            {100 * share: _quick("growth", share) for share in (0.5, 1.0)},
        )
    ],
    targets=[Target("a part moves, following motion", at_least_times=2.0)],
)
