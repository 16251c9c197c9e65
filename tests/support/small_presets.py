# SPDX-License-Identifier: Apache-2.0
"""Configurations that take seconds."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import pytest

from structgstream.data.plane_sweep import SweepConfig
from structgstream.data.points import PointsConfig
from structgstream.session.presets import PRESETS, RIG, TINY

TINY_RIG = replace(
    RIG,
    initial=replace(
        TINY.initial,
        seed_voxels=1,
        losses=RIG.initial.losses,
        perturbation=RIG.initial.perturbation,
        depth_distortion=RIG.initial.depth_distortion,
        floaters=RIG.initial.floaters,
        random_background=False,
    ),
    online=replace(RIG.online, iterations=10, patching=replace(RIG.online.patching, iteration=5)),
)
"""Paper mode as small as the preset tiny: float32, everything fitted in every frame, births by gradients."""


class FewSweeps(PointsConfig):
    """One coarse plane sweep. A class of this module, so that configurations can be sent to another process."""

    SWEEP_LEVELS = (SweepConfig(width=60, planes=(8, 12)),)


FEW_POINTS = FewSweeps(max_points=1_500)
"""Initial points for pictures of 80x60 pixels, in a tenth of the time that the usual sweeps and their points take."""

QUICK = replace(
    TINY,
    points=FEW_POINTS,
    initial=replace(TINY.initial, iterations=3),
    online=replace(TINY.online, iterations=2, patching=replace(TINY.online.patching, iteration=1)),
)
"""The preset tiny with next to no iterations."""


@contextmanager
def few_points(*names: str) -> Iterator[None]:
    """Presets of these names begin with :data:`FEW_POINTS`."""
    with pytest.MonkeyPatch.context() as patch:
        for name in names:
            patch.setitem(PRESETS, name, replace(PRESETS[name], points=FEW_POINTS))
        yield
