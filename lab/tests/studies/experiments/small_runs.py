# SPDX-License-Identifier: Apache-2.0
"""Runs that take a second: the bundled clip at 80x60 pixels, hardly trained."""

from dataclasses import replace

from structgstream.data.dataset_layouts import bundled_clip_path
from structgstream.session.presets import COMPACT, StreamConfig
from structgstream_studies.experiments.captures import CapturePart
from tests.support.small_presets import FEW_POINTS, TINY_RIG

CLIP = CapturePart(bundled_clip_path(), scale=0.25, frames=3)


def quick(*, seed: int = 0) -> StreamConfig:
    """Paper mode with next to no iterations."""
    patching = replace(TINY_RIG.online.patching, iteration=1)
    initial = replace(TINY_RIG.initial, iterations=3)
    online = replace(TINY_RIG.online, iterations=2, patching=patching)
    return replace(TINY_RIG, seed=seed, points=FEW_POINTS, initial=initial, online=online)


def compact() -> StreamConfig:
    """The preset compact with as few iterations."""
    few = quick()
    patching = replace(COMPACT.online.patching, iteration=few.online.patching.iteration)
    online = replace(COMPACT.online, iterations=few.online.iterations, patching=patching)
    whole = COMPACT.initial
    initial = replace(
        few.initial,
        losses=whole.losses,
        perturbation=whole.perturbation,
        offsets_per_anchor=whole.offsets_per_anchor,
        all_drawn=whole.all_drawn,
        floaters=whole.floaters,
    )
    return replace(COMPACT, seed=few.seed, points=few.points, initial=initial, online=online)
