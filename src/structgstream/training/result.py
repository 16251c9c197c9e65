# SPDX-License-Identifier: Apache-2.0
"""What a fit reports: its result, its steps, and its seconds by stage."""

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Generic, TypeVar


class Stopwatch:
    """Adds up wall-clock seconds by stage name, without waiting for a GPU."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time the body as part of stage ``name``."""
        started = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - started


SceneT = TypeVar("SceneT", covariant=True)


@dataclass(frozen=True)
class Step:
    """Progress within one frame's optimisation, for a progress bar."""

    iteration: int
    iterations: int
    loss: float
    anchors: int
    free: int


StepListener = Callable[[Step], None]


@dataclass(frozen=True)
class FitResult(Generic[SceneT]):
    """A fitted frame.

    Args:
        scene: the fitted scene, detached, in normalised units, before coding: a ``Scene``, or another method's
            drawable.
        iterations: optimisation steps done.
        train_psnr: mean over training cameras of the PSNR of each one's last rendering during optimisation, dB, over
            the drawn pixels; NaN without iterations.
        moving: number of trained anchors.
        grown: anchors added in frame 0.
        removed: anchors removed in frame 0.
        spawned: free Gaussians added in this frame.
        pruned: free Gaussians removed in this frame.
        counts: further counts by name.
        seconds: wall-clock seconds by stage (``generate``, ``rasterise``, ``loss``, ``backward``, ``optimise``, ...;
            native iterations are one stage, ``iterations``).
        losses: mean of each loss term over the last pass through the cameras.
    """

    scene: SceneT
    iterations: int
    train_psnr: float
    moving: int = 0
    grown: int = 0
    removed: int = 0
    spawned: int = 0
    pruned: int = 0
    counts: Mapping[str, int] = field(default_factory=dict)
    seconds: Mapping[str, float] = field(default_factory=dict)
    losses: Mapping[str, float] = field(default_factory=dict)
