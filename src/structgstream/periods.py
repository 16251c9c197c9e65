# SPDX-License-Identifier: Apache-2.0
"""Decides which frames begin another period, with a header of its own.

Note [Periods]
~~~~~~~~~~~~~~
The static fields of a header are those of one frame. When a scene has become another one, anchors and free Gaussians
have to represent what the header's fields were not made for: pictures get worse and packets larger. A period begins at
a key frame, after a time, or when the pictures have become worse than those of the period's first frame. Both are
measured on decoded scenes, so that a resumed run, which has the stream and the pictures, decides the same.
"""

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from structgstream.errors import ConfigError
from structgstream.key_frames import LEAST_FRAMES, KeyFrames


@dataclass(frozen=True)
class PeriodConfig:
    """When a stream goes on with another header, and how that is made; off by default."""

    seconds: float | None = None
    """A period ends at the first key frame after so many seconds of media time. None: not by time."""
    residual: float | None = None
    """A period ends at a key frame when the residual of the decoded frames before it exceeded this multiple of that of
    the period's first frame, such as 1.3. None: not by residual."""
    frames: int = 3
    """As many frames in a row, the last before the key frame, must exceed it."""
    start: Literal["points", "scene"] = "points"
    """The first frame of a period is fitted from initial points, as frame 0 is, or from the decoded scene before it,
    which takes less time and serves a scene that has changed in part."""
    share: float = 0.35
    """From the scene, this share of frame 0's iterations is made, the last ones of its schedule."""

    @property
    def enabled(self) -> bool:
        """Whether another period may begin."""
        return self.seconds is not None or self.residual is not None


class PeriodPlan:
    """Finds the frames that begin another period, from times and residuals of the frames before them.

    Args:
        config: when.
        most: number of periods that a stream may have; the last one goes on.

    Raises:
        ConfigError: a value is out of range.
    """

    def __init__(self, config: PeriodConfig, *, most: int) -> None:
        for name, value, least in (("seconds", config.seconds, 0.0), ("residual", config.residual, 1.0)):
            if value is not None and not least < value < math.inf:
                raise ConfigError(f"--period.{name} {value:g} is not above {least:g}; leave it out for none.")
        if config.frames < 1 or not 0.0 < config.share <= 1.0:
            raise ConfigError(
                f"--period.frames {config.frames} and --period.share {config.share:g}: frames must be at least 1, and "
                "the share above 0 and at most 1."
            )
        self._config, self._most = config, most
        self._number = 0
        self._first: tuple[int, float] | None = None  # frame and time of the period's first frame
        self._floor = math.inf
        self._last: deque[tuple[int, float]] = deque(maxlen=config.frames)  # frames and residuals

    def due(self, index: int, pts_seconds: float) -> str | None:
        """Why key frame ``index`` begins another period, in a few words; None if it does not."""
        if self._first is None or self._number + 1 >= self._most:
            return None
        config, seconds = self._config, pts_seconds - self._first[1]
        # Times are sums of rounded numbers.
        if config.seconds is not None and seconds >= config.seconds - 1e-6:
            return f"after {seconds:.3g} s"
        measured = dict(self._last)
        last = [measured[frame] for frame in range(index - config.frames, index) if frame in measured]
        whole = len(last) == config.frames and index - self._first[0] >= config.frames
        if config.residual is not None and whole and min(last) > config.residual * self._floor:
            return f"residual {min(last) / self._floor:.2f} times the first frame's"
        return None

    def begin(self, index: int, pts_seconds: float, *, number: int | None = None) -> None:
        """Frame ``index`` begins a period: the next one, or that of this number."""
        if number is not None:
            self._number = number
        elif self._first is not None:
            self._number += 1
        self._first = index, pts_seconds
        self._last.clear()

    def measures(self, index: int, pts_seconds: float, keys: KeyFrames) -> bool:
        """Whether :meth:`add` needs the residual of frame ``index``: it is the first, or soon a key frame follows.

        Where more frames than the shortest group are asked for, that is every frame: of a frame before the last key
        frame a resumed run could not tell otherwise what the first one had expected.
        """
        if self._config.residual is None or self._first is None:
            return False
        if index == self._first[0] or self._config.frames >= LEAST_FRAMES:
            return True
        return keys.near(index, pts_seconds, within=self._config.frames)

    def add(self, index: int, residual: float) -> None:
        """Take the residual of a decoded frame that :meth:`measures` asks for, in order."""
        if self._first is not None and index == self._first[0]:
            self._floor = residual
        self._last.append((index, residual))

    @property
    def remembered(self) -> int:
        """How many of the last frames :meth:`needed` may name."""
        return 0 if self._config.residual is None else self._config.frames

    def needed(self, pts_seconds: Sequence[float], keys: KeyFrames) -> list[int]:
        """The frames whose residuals a run that goes on after the frames with these times has to measure again."""
        assert self._first is not None, "a period has begun"
        first, count = self._first[0], len(pts_seconds)
        last = range(max(count - self._config.frames, first + 1), count)
        return [index for index in (first, *last) if self.measures(index, pts_seconds[index], keys)]
