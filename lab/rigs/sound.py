# SPDX-License-Identifier: Apache-2.0
"""What the microphones of the cameras hear: claps with the delay of their distance, echoes and noise."""

import math
from dataclasses import dataclass

import numpy as np

from structgstream.geometry import Floats

SAMPLE_RATE = 48_000
SPEED = 343.0  # metres a second, air at 20 degrees Celsius
FINE = 4  # the clap is tabled at so many times the sample rate
WALL_Y, FLOOR_Z = 1.15, -0.75  # metres; where sound is reflected in the room of the table
REFLECTED = 0.45


@dataclass(frozen=True)
class Clap:
    """Hands that meet at a place (metres) and an instant of common time (seconds)."""

    seconds: float
    place: tuple[float, float, float]


@dataclass(frozen=True)
class Room:
    """Claps, and the noise that every microphone has of its own.

    Args:
        claps: what is heard.
        noise: standard deviation, of full scale.
        seed: of noise and of the sound of the claps.
    """

    claps: tuple[Clap, ...]
    noise: float = 0.004
    seed: int = 0

    def heard(self, at: Floats, own_seconds: Floats, *, offset: float, rate: float, gain: float, ear: int) -> Floats:
        """Samples of a microphone at ``at [3]`` at the seconds of its own clock.

        Args:
            at: place, metres.
            own_seconds: ``[N]``, ascending.
            offset: common time of its second zero.
            rate: seconds of common time in one of its own.
            gain: its loudness; a clap a metre away has an amplitude of about 0.3 at 1.
            ear: number of the microphone, for its noise.
        """
        common = offset + rate * own_seconds
        out = np.random.default_rng((self.seed, ear)).normal(0, self.noise, len(common))
        # A hum and a rustle that all hear, with the delay of nothing: far away in the next room.
        out += 0.002 * np.sin(2 * math.pi * 50 * common)
        for clap in self.claps:
            for place, strength in _images(clap.place):
                distance = float(np.linalg.norm(at - place))
                since = common - clap.seconds - distance / SPEED
                out += strength / max(distance, 0.3) * self._clap(since)
        return np.clip(gain * out, -1, 1)

    def _clap(self, since: Floats) -> Floats:
        """A burst of noise that dies away within 60 ms; ``since`` is the time after it began."""
        count = int(0.06 * SAMPLE_RATE * FINE)
        seconds = np.arange(count) / (SAMPLE_RATE * FINE)
        burst = np.random.default_rng(self.seed + 1).normal(0, 1, count)
        smooth = np.hanning(4 * FINE + 1)
        burst = np.convolve(burst, smooth / np.sqrt((smooth**2).sum()), mode="same")  # below half the sample rate
        fading: Floats = np.asarray(0.3 * burst * np.exp(-seconds / 0.009), np.float64)
        return np.interp(since, seconds, fading, left=0, right=0)


def _images(place: tuple[float, float, float]) -> list[tuple[Floats, float]]:
    """The source and its mirror images in wall and floor (Allen and Berkley, 1979), with their strengths."""
    x, y, z = place
    mirrored = [(x, 2 * WALL_Y - y, z), (x, y, 2 * FLOOR_Z - z), (x, 2 * WALL_Y - y, 2 * FLOOR_Z - z)]
    strengths = [1.0, REFLECTED, REFLECTED, REFLECTED**2]
    return [(np.array(p), s) for p, s in zip([place, *mirrored], strengths, strict=True)]
