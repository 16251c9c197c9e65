# SPDX-License-Identifier: Apache-2.0
"""What a sensor makes of light: exposure, white balance, tone curve and noise."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lab.clip.tone import coded
from lab.rigs.filming import Filming

NOISE_LEVELS = 1.0  # of 255: standard deviation of each channel of a good camera after its own denoising


@dataclass(frozen=True)
class Sensor:
    """Turns linear pictures into what a camera stores.

    Args:
        filming: exposure and white balance.
        seed: of the noise; every picture has its own.
        noise_levels: standard deviation, of 255.
    """

    filming: Filming
    seed: int
    noise_levels: float = NOISE_LEVELS

    def exposed(self, linear: NDArray[np.float32]) -> NDArray[np.float32]:
        """sRGB values ``[H, W, 3]`` from 0 to 255, not rounded and without noise."""
        gains = np.asarray(self.filming.white_balance, np.float32) * np.float32(2.0**self.filming.stops)
        return (coded(linear * gains) * 255).astype(np.float32)

    def read(self, exposed: NDArray[np.float32], number: int) -> NDArray[np.uint8]:
        """The picture of that number: noise, and 8 bits."""
        rng = np.random.default_rng((self.seed, number))
        noise = rng.standard_normal(exposed.shape, dtype=np.float32) * self.noise_levels
        return (np.clip(exposed + noise, 0, 255) + 0.5).astype(np.uint8)
