# SPDX-License-Identifier: Apache-2.0
"""A bright block that moves before four cameras, and a configuration under which it begins a second period."""

from dataclasses import replace

import numpy as np

from structgstream.session.periods import PeriodConfig
from tests.support.rigs import arc_rig
from tests.support.small_presets import QUICK

RIG = arc_rig(4, width=40, height=30)
PERIODS = replace(
    QUICK, key_interval_seconds=0.1, period=PeriodConfig(seconds=0.7, residual=9.0, frames=2, start="scene", share=0.5)
)
"""Another period begins with frame 3."""


def filmed(number: int) -> dict[str, np.ndarray]:
    """The pictures of every camera."""
    images = {}
    for turn, name in enumerate(RIG):
        picture = np.full((30, 40, 3), 60 + 10 * turn, np.uint8)
        picture[8:20, (number * 2) % 28 : (number * 2) % 28 + 10] = (220, 180, 40)
        images[name] = picture
    return images
