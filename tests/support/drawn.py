# SPDX-License-Identifier: Apache-2.0
"""What a picture file shows, for tests."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tests.support.pictures import decoded_picture


def pixels_of(path: Path) -> NDArray[np.uint8]:
    """``[H, W, 3]``, red first."""
    return decoded_picture(path.read_bytes())


def coloured(picture: NDArray[np.uint8], colour: str) -> int:
    """How many pixels have this very colour."""
    wanted = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)], np.uint8)
    return int((picture == wanted).all(axis=2).sum())
