# SPDX-License-Identifier: Apache-2.0
"""What fitting one frame gives back, and what it says while it works."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Generic, TypeVar

SceneT = TypeVar("SceneT", covariant=True)
OtherT = TypeVar("OtherT")


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
        scene: what was fitted, detached, in normalised units, before it was coded: a ``Scene``, or what another method
            draws.
        iterations: optimisation steps done.
        train_psnr: mean over training cameras of the PSNR of the last rendering of each during optimisation, dB, over
            the pixels that were drawn; NaN when there was nothing to do.
        moving: anchors that were free to move.
        grown: anchors added while frame 0 was fitted.
        removed: anchors taken away while frame 0 was fitted.
        spawned: free Gaussians added in this frame.
        pruned: free Gaussians removed in this frame.
        counts: how often each further mechanism acted, by its name.
        seconds: wall-clock seconds by stage (``render``, ``loss``, ``backward``, ``optimise``, ``patch``, ...).
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

    def with_scene(self, scene: OtherT) -> "FitResult[OtherT]":
        """The same fit, seen as of ``scene``."""
        return FitResult(**{**vars(self), "scene": scene})
