# SPDX-License-Identifier: Apache-2.0
"""Runs that take a second: the bundled clip at 80x60 pixels, hardly trained."""

from dataclasses import replace

from structgstream.data.clip import bundled_clip_path
from structgstream.experiments.captures import CapturePart
from structgstream.presets import COMPACT, RIG, TINY, StreamConfig

CLIP = CapturePart(bundled_clip_path(), scale=0.25, frames=3)


def quick(*, seed: int = 0) -> StreamConfig:
    """Paper mode with next to no iterations."""
    patching = replace(RIG.online.patching, iteration=1)
    initial = replace(TINY.initial, iterations=3, disturbance=RIG.initial.disturbance, random_background=False)
    return replace(RIG, seed=seed, initial=initial, online=replace(RIG.online, iterations=2, patching=patching))


def compact(*, seed: int = 0) -> StreamConfig:
    """The preset compact with as few iterations."""
    few = quick(seed=seed)
    patching = replace(COMPACT.online.patching, iteration=few.online.patching.iteration)
    online = replace(COMPACT.online, iterations=few.online.iterations, patching=patching)
    return replace(COMPACT, seed=seed, initial=few.initial, online=online)
