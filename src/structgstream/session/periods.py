# SPDX-License-Identifier: Apache-2.0
"""Which frames are key frames, and which of them begin another period, with a header of its own.

A key frame begins a group that can be decoded without earlier packets. Without skipped frames a key frame comes at a
constant interval of frames. A live run that skips pictures has fewer frames per second. Its groups end after the
duration of that interval, but not before they have :data:`MIN_FRAMES` frames, because key packets are several times as
large as others.

Note [Periods]
~~~~~~~~~~~~~~
The static fields of a header are fitted to one frame. After a large change of the scene, anchors and free Gaussians
have to represent content that these fields do not fit: pictures get worse and packets larger. A period begins at a key
frame, after a given time or when the residual exceeds that of the period's first frame. Residuals are measured on
decoded scenes, so that a resumed run, which has the stream and the pictures, makes the same decisions.
"""

import math
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import count
from typing import Literal

from structgstream.codec.container.records import MAX_PERIODS
from structgstream.codec.packets import PacketKind
from structgstream.errors import ConfigError

MIN_FRAMES = 5
_SAME = 0.5  # tolerance in frames, because times of frames jitter


class KeyFrames:
    """Follows a stream's packets and decides the kind of the next one; a group has ``interval`` frames without skipped
    ones."""

    def __init__(self, interval: int, fps: float) -> None:
        self.interval, self._seconds = interval, (interval - _SAME) / fps
        self._key: tuple[int, float] | None = None

    def kind(self, index: int, pts_seconds: float) -> PacketKind:
        """The kind of the packet of frame ``index`` at ``pts_seconds``."""
        ends = self._key is None or self._ends(index - self._key[0], pts_seconds - self._key[1])
        return PacketKind.KEY if ends else PacketKind.DELTA

    def near(self, index: int, pts_seconds: float, *, within: int) -> bool:
        """Whether a key frame comes within ``within`` frames after frame ``index``, at the frame rate of this group."""
        if self._key is None:
            return False
        frames, seconds = index - self._key[0], pts_seconds - self._key[1]
        spacing = seconds / frames if frames else 0.0
        return self._ends(frames + within, seconds + within * spacing)

    @property
    def least(self) -> int:
        """Smallest number of frames in a group."""
        return min(self.interval, MIN_FRAMES)

    def ahead(self, index: int, pts_seconds: float, *, spacing: float) -> Iterator[int]:
        """Distances of the next key frames from frame ``index``, in frames; frames come every ``spacing`` seconds."""
        key_index, key_seconds = (index, pts_seconds) if self._key is None else self._key
        first = self._length(index - key_index, pts_seconds - key_seconds, spacing)
        return count(first, self._length(0, 0.0, spacing))

    def begin(self, index: int, pts_seconds: float) -> None:
        """Record that frame ``index`` was written as a key frame."""
        self._key = index, pts_seconds

    def _length(self, frames: int, seconds: float, spacing: float) -> int:
        """Number of further frames of a group with this number of frames and this duration."""
        return next(more for more in count(1) if self._ends(frames + more, seconds + more * spacing))

    def _ends(self, frames: int, seconds: float) -> bool:
        """Whether a group with this number of frames and this duration ends here."""
        return frames >= self.interval or (frames >= MIN_FRAMES and seconds >= self._seconds)


@dataclass(frozen=True)
class PeriodConfig:
    """When a stream continues with another header, and how it is fitted; off by default."""

    seconds: float | None = None
    """A period ends at the first key frame after so many seconds of media time. None: no limit of time."""
    residual: float | None = None
    """A period ends at a key frame if the residuals of the decoded frames before it exceed this multiple of that of the
    period's first frame, such as 1.3. None: no limit of the residual."""
    frames: int = 3
    """Number of consecutive frames before the key frame that must exceed it."""
    start: Literal["points", "scene"] = "points"
    """The first frame of a period is fitted from initial points, as frame 0 is, or from the decoded scene before it,
    which takes less time and suits a scene that has changed in part."""
    share: float = 0.35
    """Share of frame 0's iterations, from the end of its schedule, for a fit from the decoded scene."""

    @property
    def enabled(self) -> bool:
        """Whether another period may begin."""
        return self.seconds is not None or self.residual is not None


class PeriodPlan:
    """Finds the frames that begin another period, from times and residuals of the frames before them; the last of
    :data:`MAX_PERIODS` does not end. Raises ConfigError if a value is out of range."""

    def __init__(self, config: PeriodConfig) -> None:
        for name, value, least in (("seconds", config.seconds, 0.0), ("residual", config.residual, 1.0)):
            if value is not None and not least < value < math.inf:
                raise ConfigError(f"--period.{name} {value:g} is not above {least:g}; leave it out for no limit.")
        if config.frames < 1 or not 0.0 < config.share <= 1.0:
            raise ConfigError(
                f"--period.frames {config.frames} and --period.share {config.share:g}: frames must be at least 1, and "
                "the share above 0 and at most 1."
            )
        self._config = config
        self._number = 0
        self._first: tuple[int, float] | None = None  # frame and time of the period's first frame
        self._baseline = math.inf
        self._last: deque[tuple[int, float]] = deque(maxlen=config.frames)  # frames and residuals

    def due(self, index: int, pts_seconds: float) -> str | None:
        """Why key frame ``index`` begins another period, in a few words; None if it does not."""
        if self._first is None or self._number + 1 >= MAX_PERIODS:
            return None
        config, seconds = self._config, pts_seconds - self._first[1]
        # Tolerance for times, which are sums of rounded numbers.
        if config.seconds is not None and seconds >= config.seconds - 1e-6:
            return f"after {seconds:.3g} s"
        measured = dict(self._last)
        last = [measured[frame] for frame in range(index - config.frames, index) if frame in measured]
        whole = len(last) == config.frames and index - self._first[0] >= config.frames
        if config.residual is not None and whole and min(last) > config.residual * self._baseline:
            return f"residual {min(last) / self._baseline:.2f} times the first frame's"
        return None

    def begin(self, index: int, pts_seconds: float, *, number: int | None = None) -> None:
        """Record that frame ``index`` begins a period: the next one, or that with this number."""
        if number is not None:
            self._number = number
        elif self._first is not None:
            self._number += 1
        self._first = index, pts_seconds
        self._last.clear()

    def measures(self, index: int, pts_seconds: float, keys: KeyFrames) -> bool:
        """Whether :meth:`add` needs the residual of frame ``index``: it is the first, or a key frame follows soon.

        If ``config.frames`` is :data:`MIN_FRAMES` or more, every frame is needed, because a resumed run cannot
        reconstruct which key frame was expected in an earlier group.
        """
        if self._config.residual is None or self._first is None:
            return False
        if index == self._first[0] or self._config.frames >= MIN_FRAMES:
            return True
        return keys.near(index, pts_seconds, within=self._config.frames)

    def add(self, index: int, residual: float) -> None:
        """Add the residual of a decoded frame for which :meth:`measures` is True; in order of frames."""
        if self._first is not None and index == self._first[0]:
            self._baseline = residual
        self._last.append((index, residual))

    @property
    def remembered(self) -> int:
        """Number of last frames among which those of :meth:`needed` are."""
        return 0 if self._config.residual is None else self._config.frames

    def needed(self, pts_seconds: Sequence[float], keys: KeyFrames) -> list[int]:
        """The frames whose residuals must be measured again by a run that resumes after frames at these times."""
        assert self._first is not None, "a period has begun"
        first, count = self._first[0], len(pts_seconds)
        last = range(max(count - self._config.frames, first + 1), count)
        return [index for index in (first, *last) if self.measures(index, pts_seconds[index], keys)]
