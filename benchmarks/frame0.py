# SPDX-License-Identifier: Apache-2.0
"""Frame 0 of the bundled clip with few iterations: growth of anchors, small pictures first, nine training cameras."""

from collections.abc import Mapping
from dataclasses import replace

import torch

from benchmarks.benchmark import Benchmark, Variant
from benchmarks.contenders import contenders
from benchmarks.contest import Contestant, Quantity, Results
from structgstream.cameras import normalizing_similarity
from structgstream.data.dataset_layouts import bundled_clip
from structgstream.data.points import initial_points
from structgstream.data.source import resized
from structgstream.kernels.backend import Backend
from structgstream.session.presets import FAST, TINY
from structgstream.training.frame0.fit import fit_first_frame
from structgstream.training.result import FitResult


def contestants(*, iterations: int, scale: float, points: int) -> list[Contestant]:
    """The back-ends of whole fits; ``points`` are made before."""
    source = resized(bundled_clip(), scale)
    frame = next(iter(source.frames()))
    similarity = normalizing_similarity(source.rig, radius=TINY.NORMALISED_RADIUS)
    made = initial_points(frame, source.rig, config=replace(FAST.points, max_points=points), seed=0)
    # The tiny schedule stretched: a fixed share of the iterations on small pictures and before each growth.
    stretch = iterations / TINY.initial.iterations
    growth = TINY.initial.growth
    config = replace(
        TINY.initial,
        iterations=iterations,
        schedule_iterations=iterations,
        coarse_iterations=round(TINY.initial.coarse_iterations * stretch),
        growth=replace(
            growth,
            collect_from=round(growth.collect_from * stretch),
            start=round(growth.start * stretch),
            stop=round(growth.stop * stretch),
        ),
    )

    def entry(name: str, backend: Backend, threads: int) -> Contestant:
        fits: list[FitResult] = []

        def run() -> Results:
            fit = fit_first_frame(
                frame,
                similarity.rig(source.rig),
                similarity.points(torch.from_numpy(made)),
                config=config,
                backend=backend,
                seed=0,
            )
            fits[:] = [fit]
            return [torch.tensor(fit.train_psnr), torch.tensor(float(len(fit.scene.anchors)))]

        def facts() -> Mapping[str, float]:
            return {"train psnr": fits[0].train_psnr, "anchors": float(len(fits[0].scene.anchors))}

        return Contestant(name, run, threads, facts=facts)

    return [entry(*contender) for contender in contenders()]


BENCHMARK = Benchmark(
    name="frame0",
    work="fitting frame 0 of the bundled clip, without making its initial points",
    contestants=contestants,
    # Rounding grows over the iterations and through the thresholds of growth; the result must be as good.
    quantities=[Quantity("train PSNR", 0.3, "largest"), Quantity("number of anchors", 0.05)],
    variants=[
        Variant(
            "60 iterations, 320x240",
            {"iterations": 60, "scale": 1.0, "points": 60_000},
            {"iterations": 12, "scale": 0.2, "points": 500},
        ),
    ],
)
