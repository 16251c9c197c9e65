# SPDX-License-Identifier: Apache-2.0
"""Runs that take a second: the bundled clip at 80x60 pixels, hardly trained."""

from dataclasses import replace

from structgstream.data.clip import bundled_clip_path
from structgstream.experiments.captures import CapturePart
from structgstream.presets import COMPACT, TINY, StreamConfig

CLIP = CapturePart(bundled_clip_path(), scale=0.25, frames=3)


def quick(*, seed: int = 0) -> StreamConfig:
    """The preset tiny with next to no iterations."""
    patching = replace(TINY.online.patching, iteration=1)
    return replace(
        TINY,
        seed=seed,
        initial=replace(TINY.initial, iterations=3),
        online=replace(TINY.online, iterations=2, patching=patching),
    )


def compact(*, seed: int = 0) -> StreamConfig:
    """The preset compact with as few iterations."""
    few = quick(seed=seed)
    online = replace(COMPACT.online, iterations=few.online.iterations, patching=few.online.patching)
    return replace(COMPACT, seed=seed, initial=few.initial, online=online)
