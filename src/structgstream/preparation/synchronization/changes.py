# SPDX-License-Identifier: Apache-2.0
"""Where and when the pictures of a still camera change."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from structgstream.data.arrays import Floats
from structgstream.data.images import opencv, reduced_picture

LONGER_SIDE = 160  # of reduced pictures, pixels: events are compared along lines, so positions need not be finer
SMOOTHING = 1.0  # standard deviation, reduced pixels
SAMPLED = 100  # frames whose noise is measured
NOISE_FACTOR, MIN_NOISE = 4.0, 0.5  # changes below this many times the median change are noise
MOST = 30.0  # larger changes count as this one: a bright shirt is not more of an event than a dark one
UNITS = 4  # of stored changes in a grey level
STILL = 5e-4  # share of MOST of a mean change below which nothing moves


@dataclass(frozen=True)
class Changes:
    """Changes of a camera's pictures.

    Args:
        amounts: ``[T - 1, h, w]`` uint8: change from a frame to the next one above noise, in quarters of a grey level.
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
        return len(self.amounts) > 1 and float(self.amounts.mean()) > STILL * MOST * UNITS


def picture_changes(pictures: Iterable[NDArray[np.uint8]], stamps: Floats) -> Changes:
    """Changes of pictures ``[H, W, 3]`` that follow each other at ``stamps`` ``[T]``; only reduced ones are kept.

    Raises:
        MissingExtraError: cv2 is not installed.
    """
    reduced: list[NDArray[np.uint8]] = []
    size = (0, 0)
    for picture in pictures:
        size = (picture.shape[1], picture.shape[0])
        reduced.append(reduced_grey(picture))
    return reduced_changes(reduced, stamps[: len(reduced)], size)


def reduced_grey(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """A picture ``[H, W, 3]`` as grey ``[h, w]`` whose longer side is at most :data:`LONGER_SIDE`."""
    cv2 = opencv()
    # Reduced first: grey of a large picture would take longer than all else.
    return cv2.cvtColor(reduced_picture(picture, LONGER_SIDE), cv2.COLOR_RGB2GRAY)


def reduced_changes(reduced: Sequence[NDArray[np.uint8]], stamps: Floats, size: tuple[int, int]) -> Changes:
    """Changes of reduced pictures ``[h, w]`` at ``stamps`` ``[T]`` of a camera of this width and height."""
    if len(reduced) < 2:
        return Changes(np.zeros((0, 1, 1), np.uint8), np.zeros(0), size)
    cv2 = opencv()
    noise = _noise(reduced)
    amounts = np.empty((len(reduced) - 1, *reduced[0].shape), np.uint8)
    before = cv2.GaussianBlur(reduced[0].astype(np.float32), (0, 0), SMOOTHING)
    for index, grey in enumerate(reduced[1:]):
        smooth = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), SMOOTHING)
        above = np.clip(np.abs(smooth - before) - noise, 0, MOST)
        amounts[index] = np.rint(above * UNITS)
        before = smooth
    return Changes(amounts, (stamps[1:] + stamps[:-1]) / 2, size)


def _noise(reduced: Sequence[NDArray[np.uint8]]) -> float:
    """The change that counts as noise: a multiple of the median one, of some of the frames."""
    cv2 = opencv()
    firsts = np.unique(np.linspace(0, len(reduced) - 2, min(len(reduced) - 1, SAMPLED)).astype(int))
    steps = []
    for first in firsts.tolist():
        pair = [cv2.GaussianBlur(grey.astype(np.float32), (0, 0), SMOOTHING) for grey in reduced[first : first + 2]]
        steps.append(np.abs(pair[1] - pair[0]))
    return NOISE_FACTOR * max(float(np.median(np.stack(steps))), MIN_NOISE)
