# SPDX-License-Identifier: Apache-2.0
"""What a picture file shows, for tests."""

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray


def pixels_of(path: Path) -> NDArray[np.uint8]:
    """``[H, W, 3]``, red first."""
    picture = cv2.imread(str(path))
    assert picture is not None
    return np.asarray(picture[..., ::-1], np.uint8)


def coloured(picture: NDArray[np.uint8], colour: str) -> int:
    """How many pixels have this very colour."""
    wanted = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)], np.uint8)
    return int((picture == wanted).all(axis=2).sum())
