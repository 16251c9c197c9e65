# SPDX-License-Identifier: Apache-2.0
"""Frame 0 with less sensor noise: pixels that stand still become means over frame 0 and the frames after it.

Note [Means of still pixels]
~~~~~~~~~~~~~~~~~~~~~~~~~~~~
Every camera has noise of its own in every picture, and a fit of thousands of iterations learns that of frame 0 by
heart: it is wrong between the cameras, and in all later frames, which inherit frame 0. The mean of n pictures has
noise of 1 / sqrt(n). A pixel is averaged over consecutive frames as long as its surroundings stay as they are in frame
0; what moves keeps its one picture, sharp. Only frames on which all others depend are averaged: frame 0, and the first
frame of a group that is fitted separately. For later frames it gained nothing (lab/notes/compact-measured.md).
"""

from collections.abc import Iterable, Iterator
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
from itertools import chain, islice
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from structgstream.cameras import enlargement
from structgstream.data.images import opencv
from structgstream.data.source import FrameStream, SourceWrapper, closed, is_recording
from structgstream.errors import CaptureError, ConfigError
from structgstream.frames import MultiViewFrame, check_pictures

SMOOTHING_PIXELS = 3
MAX_FRAMES = 256  # sums of 8-bit pictures are 16-bit numbers


@dataclass(frozen=True)
class DenoisingConfig:
    """Means over frames of pixels that stand still (Note [Means of still pixels])."""

    frames: int = 1
    """The training pictures of frame 0 are means over as many frames, itself and those after it (paper: 1)."""

    THRESHOLD: ClassVar[float] = 0.024
    """A pixel is static while the smoothed difference to frame 0, in 0 ... 1, in the channel that differs most, is
    below this everywhere around it."""
    REACH_PIXELS: ClassVar[int] = 3
    """Distance up to which the surroundings of a pixel have to be static, too, in pixels of a picture of the reference
    size (``cameras.enlargement``)."""

    def __post_init__(self) -> None:
        if not 1 <= self.frames <= MAX_FRAMES:
            raise ConfigError(f"Denoising takes 1 to {MAX_FRAMES} frames; got {self.frames}.")


@dataclass(frozen=True)
class Denoised(SourceWrapper):
    """The same frames; the training pictures of the frames ``at`` are means over these and the frames after them."""

    config: DenoisingConfig
    at: tuple[int, ...]

    def frames(self, start: int = 0) -> Iterator[MultiViewFrame]:
        with closed(self.source.frames(start)) as frames:
            for frame in frames:
                yield self._mean(frame) if frame.index in self.at else frame

    def _mean(self, frame: MultiViewFrame) -> MultiViewFrame:
        check_pictures(frame, self.rig, capture=self.name)
        # These frames are read again later: holding all of them would take their pictures' memory.
        with ExitStack() as stack:
            following = frame.index + 1
            own = self.source.frames(following) if following < len(self.source) else iter(())
            after = self.source.frames_after() if isinstance(self.source, SourceWrapper) else iter(())
            later = chain(stack.enter_context(closed(own)), stack.enter_context(closed(after)))

            def readable() -> Iterator[MultiViewFrame]:  # what cannot be read raises when it is reached itself
                with suppress(CaptureError):
                    yield from later

            return mean_of_still(frame, readable(), names=self.rig.training, config=self.config)


def denoised(source: FrameStream, config: DenoisingConfig, *, at: tuple[int, ...] = (0,)) -> FrameStream:
    """A recording with means in the frames ``at``; live cameras, which average themselves, unchanged."""
    return Denoised(source, config, at) if config.frames > 1 and is_recording(source) else source


def mean_of_still(
    frame: MultiViewFrame, later: Iterable[MultiViewFrame], *, names: Iterable[str], config: DenoisingConfig
) -> MultiViewFrame:
    """``frame`` with the means of its pixels over the frames ``later``, as long as they stand still, rounded to 8 bits.

    ``config.frames - 1`` of ``later`` are read; pictures of other cameras than ``names`` stay. ``mean_of`` of the
    result is the mean number of pictures over which a pixel was averaged.
    """
    sums = {name: _Sum(frame.images[name], frame.masks.get(name), config) for name in names if name in frame.images}
    for other in islice(later, config.frames - 1):
        for name, found in sums.items():
            found.add(other.images.get(name), other.masks.get(name))
    if not sums:
        return frame
    mean_of = float(np.mean([found.count.mean() for found in sums.values()]))
    images = {name: sums[name].mean() if name in sums else image for name, image in frame.images.items()}
    return replace(frame, images=images, mean_of=mean_of)


class _Sum:
    """The sum of one camera's pictures, pixel by pixel until it changes. Integers, so that it repeats bit for bit."""

    def __init__(self, image: NDArray[np.uint8], mask: NDArray[np.bool_] | None, config: DenoisingConfig) -> None:
        self._config, self._image, self._mask = config, image, mask
        self._total = image.astype(np.uint16)
        self.count = np.ones(image.shape[:2], np.uint16)
        self._still = np.ones(image.shape[:2], bool) if mask is None else mask.copy()

    def add(self, image: NDArray[np.uint8] | None, mask: NDArray[np.bool_] | None) -> None:
        """Adds the next frame's picture; where it lacks, nothing is added from here on."""
        if image is None or image.shape != self._image.shape:
            self._still[:] = False
            return
        first, other = self._image, image
        for counting in (self._mask, mask):
            if counting is not None:  # Masked pixels do not make their surroundings moving.
                first, other = first * counting[..., None], other * counting[..., None]
        self._still &= _unchanged(first, other, self._config)
        if mask is not None:
            self._still &= mask
        self._total += image * self._still[..., None].view(np.uint8)
        self.count += self._still

    def mean(self) -> NDArray[np.uint8]:
        """The mean, rounded to the nearest."""
        count = self.count[..., None]
        return ((self._total + count // 2) // count).astype(np.uint8)


def _unchanged(first: NDArray[np.uint8], other: NDArray[np.uint8], config: DenoisingConfig) -> NDArray[np.bool_]:
    """Where two pictures of a camera stand still. Sums of integers, which float32 holds exactly."""
    cv2 = opencv()
    difference = cv2.absdiff(_box_sums(first), _box_sums(other))
    around = _box_sums(cv2.max(cv2.max(difference[..., 0], difference[..., 1]), difference[..., 2]))
    height, width = first.shape[:2]
    reach = 2 * round(config.REACH_PIXELS * enlargement(width, height)) + 1
    most = cv2.dilate(around, np.ones((reach, reach), np.uint8))
    return most < config.THRESHOLD * 255.0 * SMOOTHING_PIXELS**4


def _box_sums(values: Any) -> Any:
    """Sums over the squares of SMOOTHING_PIXELS around each pixel, float32."""
    cv2 = opencv()
    return cv2.boxFilter(values, cv2.CV_32F, (SMOOTHING_PIXELS, SMOOTHING_PIXELS), normalize=False)
