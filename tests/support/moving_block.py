# SPDX-License-Identifier: Apache-2.0
"""A bright block that moves before four cameras, live ones too, and a configuration under which it begins a second
period."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from structgstream.data.live.resume_cache import ResumeCache, resume_folder
from structgstream.frames import MultiViewFrame
from structgstream.session.periods import PeriodConfig
from tests.support.rigs import arc_rig
from tests.support.small_presets import QUICK

RIG = arc_rig(4, width=40, height=30)
PERIODS = replace(
    QUICK, key_interval_seconds=0.1, period=PeriodConfig(seconds=0.7, residual=9.0, frames=2, start="scene", share=0.5)
)
"""Another period begins with frame 3."""


POINTS = np.random.default_rng(0).normal(size=(40, 3)) * 0.3


def filmed(number: int) -> dict[str, np.ndarray]:
    """The pictures of every camera."""
    images = {}
    for turn, name in enumerate(RIG):
        picture = np.full((30, 40, 3), 60 + 10 * turn, np.uint8)
        picture[8:20, (number * 2) % 28 : (number * 2) % 28 + 10] = (220, 180, 40)
        images[name] = picture
    return images


class LiveBlock:
    """Cameras that film each picture once; what a resumed run needs is kept beside the stream.

    Attributes:
        instant: the number of the picture that is filmed now, which a test sets.
        filmed: by frame, the instant at which it was asked for.
    """

    rig, fps, name, points = RIG, 30.0, "now", POINTS

    def __init__(self, stream: Path, frames: int, *, resume: bool = False) -> None:
        self._frames, self._resume = frames, resume
        self._cache = ResumeCache(resume_folder(stream), cameras=self.rig.training, resume=resume)
        self.instant = 0
        self.filmed: dict[int, int] = {}

    def retain(self, *first: int, last: int) -> None:
        """See ``RetainsFrames``."""
        self._cache.retain(*first, last=last)

    def frames(self, start: int = 0) -> Iterator[MultiViewFrame]:
        """Those that are kept, then those that are filmed, whose content is given by their number."""
        index = start
        for frame in self._cache.frames(start) if self._resume else ():
            yield frame
            index = frame.index + 1
        for number in range(index, self._frames):
            self.filmed[number] = self.instant
            frame = MultiViewFrame(number, number / 4, filmed(number))
            self._cache.store(frame, origin_seconds=0.0)
            yield frame
