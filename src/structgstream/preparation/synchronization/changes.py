# SPDX-License-Identifier: Apache-2.0
"""Where and when the pictures of a still camera change."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from structgstream.data.images import opencv

Floats = NDArray[np.float64]

WIDTH = 160  # of reduced pictures, pixels: events are compared along lines, so positions need not be finer
NOISE_FACTOR, LEAST_NOISE = 4.0, 0.5  # changes below this many times the median change are noise
MOST = 30.0  # larger changes count as this one: a bright shirt is not more of an event than a dark one
STILL = 2e-3  # mean change below which nothing moves, of MOST


@dataclass(frozen=True)
class Changes:
    """Changes of a camera's pictures.

    Args:
        amounts: ``[T - 1, h, w]`` uint8: change from a frame to the next one above noise, at most :data:`MOST`.
        times: ``[T - 1]`` seconds by the camera's clock, halfway between both frames.
        size: width and height of the camera's pictures, pixels.
    """

    amounts: NDArray[np.uint8]
    times: Floats
    size: tuple[int, int]

    @property
    def activity(self) -> Floats:
        """``[T - 1, 1]``: sum over the picture of the square roots of changes."""
        return np.sqrt(self.amounts, dtype=np.float32).mean((1, 2), dtype=np.float64)[:, None]

    @property
    def moving(self) -> bool:
        """Whether anything moves."""
        return len(self.amounts) > 1 and float(self.amounts.mean()) > STILL * MOST


def picture_changes(pictures: Iterable[NDArray[np.uint8]], stamps: Floats) -> Changes:
    """Changes of pictures ``[H, W, 3]`` that follow each other at ``stamps`` ``[T]``; only reduced ones are kept.

    Raises:
        MissingExtraError: cv2 is not installed.
    """
    cv2 = opencv()
    reduced: list[NDArray[np.uint8]] = []
    size = (0, 0)
    for picture in pictures:
        height, width = picture.shape[:2]
        size = (width, height)
        small = (WIDTH, max(round(WIDTH * height / width), 1)) if width >= height else (
            max(round(WIDTH * width / height), 1), WIDTH)  # fmt: skip
        grey = cv2.resize(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY), small, interpolation=cv2.INTER_AREA)
        reduced.append(grey)
    return _changes(reduced, stamps[: len(reduced)], size)


def _changes(reduced: list[NDArray[np.uint8]], stamps: Floats, size: tuple[int, int]) -> Changes:
    cv2 = opencv()
    steps = []
    before = None
    for grey in reduced:
        smooth = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), 1.0)
        if before is not None:
            steps.append(np.abs(smooth - before).astype(np.float16))
        before = smooth
    if not steps:
        return Changes(np.zeros((0, 1, 1), np.uint8), np.zeros(0), size)
    stacked = np.stack(steps)
    noise = NOISE_FACTOR * max(float(np.median(stacked[:: max(len(stacked) // 100, 1)])), LEAST_NOISE)
    amounts = np.clip(stacked - np.float16(noise), 0, MOST)
    # Half units, so that uint8 keeps twice as many levels as needed.
    return Changes(np.rint(amounts * 2).astype(np.uint8), (stamps[1:] + stamps[:-1]) / 2, size)
