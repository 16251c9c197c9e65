# SPDX-License-Identifier: Apache-2.0
"""From linear light to 8-bit pictures."""

import numpy as np
from numpy.typing import NDArray

EXPOSURE = 0.95
KNEE = 0.6


def developed(linear: NDArray[np.floating]) -> NDArray[np.uint8]:
    """8-bit sRGB: exposure, a soft shoulder above 0.6 in place of clipping, and the sRGB curve."""
    return (coded(linear) * 255 + 0.5).astype(np.uint8)


def coded(linear: NDArray[np.floating]) -> NDArray[np.floating]:
    """The same before rounding, from 0 to 1."""
    x = np.clip(linear * EXPOSURE, 0, None)
    x = np.where(x > KNEE, KNEE + (1 - KNEE) * (1 - np.exp(-(x - KNEE) / (1 - KNEE))), x)
    x = np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 1e-8) ** (1 / 2.4) - 0.055)
    return np.clip(x, 0, 1)
