# SPDX-License-Identifier: Apache-2.0
"""How a camera films, as values: its lens, its clock, its exposure, and what goes wrong with it.

The scene goes back and forth on its own time in steps of 1/60 s, so that a take of any length is made of few traced
pictures. All instants at which a picture is taken lie on these steps: the pictures are exact, and what a camera's clock
makes of them is free.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lab.rigs.rig import STEP_SECONDS, STEPS

FPS = 30.0
TICKS_PER_FRAME = 2
PACE_TICKS = 15  # between the instants at which the scene's speed is drawn
RESTS = 0.2  # share of these at which it stands still
FASTEST = 1.9 / (STEPS - 1)  # radians a tick: less than a step of the scene
FIRST_PHASE = -0.85  # radians: it begins in motion


@dataclass(frozen=True)
class Filming:
    """What one camera does.

    Args:
        lens: name of a lens of ``optics.py``.
        focal_factor: focal length over the lens's usual one.
        principal_offset: of the principal point from the middle of the picture, pixels.
        begins_tick: the tick, 1/60 s of common time, of its first picture; its own stamps begin at zero.
        rate: seconds of common time in a second of its own stamps.
        stops: exposure, in powers of two.
        white_balance: gains of red, green and blue, in linear light.
        dropped: pictures of its own count that the file lacks; the stamps of the others stay.
        dies_after: its file ends after so many pictures; None for a camera that lives.
        bumped_from: the picture from which on it stands in its bumped pose; None for never.
    """

    lens: str = "mild"
    focal_factor: float = 1.0
    principal_offset: tuple[float, float] = (0.0, 0.0)
    begins_tick: int = 0
    rate: float = 1.0
    stops: float = 0.0
    white_balance: tuple[float, float, float] = (1.0, 1.0, 1.0)
    dropped: tuple[int, ...] = ()
    dies_after: int | None = None
    bumped_from: int | None = None

    @property
    def offset_seconds(self) -> float:
        """Common time of its stamp zero."""
        return self.begins_tick * STEP_SECONDS

    def ticks(self, frames: int) -> NDArray[np.int64]:
        """The tick of each of its pictures, dropped ones too, in a take of so many frames.

        A clock of another rate slides through the common one: each picture is taken at the tick nearest to its instant,
        and its stamp says exactly when that was.
        """
        ideal = self.begins_tick + np.arange(frames) * TICKS_PER_FRAME * self.rate
        return np.rint(ideal).astype(np.int64)

    def stamps(self, frames: int) -> NDArray[np.float64]:
        """What its clock shows for each of :meth:`ticks`, seconds."""
        return np.asarray((self.ticks(frames) * STEP_SECONDS - self.offset_seconds) / self.rate, np.float64)

    def kept(self, frames: int) -> NDArray[np.int64]:
        """Numbers of the pictures that are in the file."""
        numbers = np.arange(frames if self.dies_after is None else min(self.dies_after, frames))
        return numbers[~np.isin(numbers, self.dropped)]


def walk(ticks: int, *, seed: int) -> NDArray[np.int64]:
    """The step of the scene, 0 to ``STEPS - 1``, at each tick.

    The scene swings on its own time as a pendulum does whose speed varies by chance and that sometimes rests: smoothly,
    as things move that are filmed at 30 frames a second, and never twice alike.
    """
    rng = np.random.default_rng(seed)
    pace = np.interp(np.arange(ticks) / PACE_TICKS, *_paces(rng, ticks))
    phase = FIRST_PHASE + np.concatenate([[0.0], np.cumsum(pace)[:-1]])
    middle = (STEPS - 1) / 2
    return np.floor(middle + middle * np.sin(phase) + 0.5).astype(np.int64)


def _paces(rng: np.random.Generator, ticks: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Times, in units of :data:`PACE_TICKS`, and radians a tick at them; the first ones are fast."""
    count = ticks // PACE_TICKS + 3
    pace = rng.uniform(0.4, 1.0, count) * (rng.random(count) > RESTS)
    pace[:2] = 1.0
    return np.arange(count, dtype=np.float64), pace * FASTEST
