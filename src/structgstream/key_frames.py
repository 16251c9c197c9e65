# SPDX-License-Identifier: Apache-2.0
"""Which frames begin a group that can be decoded without earlier packets.

Where no frame is left out that is every so many frames. A live run that leaves out pictures has few frames a second:
there the group ends when it has lasted as long as the same number of frames of the media, unless it would have fewer
than :data:`LEAST_FRAMES`, since key packets are several times as large as others.
"""

from collections.abc import Iterator
from itertools import count

from structgstream.codec.packets import PacketKind

LEAST_FRAMES = 5
_SAME = 0.5  # of a frame: times of frames are not quite even


class KeyFrames:
    """Follows a stream's packets and says what the next frame is.

    Args:
        interval: frames of a group where none is left out.
        fps: frames a second of the media.
    """

    def __init__(self, interval: int, fps: float) -> None:
        self._interval, self._seconds = interval, (interval - _SAME) / fps
        self._key: tuple[int, float] | None = None

    def kind(self, index: int, pts_seconds: float) -> PacketKind:
        """What frame ``index`` at ``pts_seconds`` is to be."""
        if self._key is None:
            return PacketKind.KEY
        return PacketKind.KEY if self._ends(index - self._key[0], pts_seconds - self._key[1]) else PacketKind.DELTA

    def near(self, index: int, pts_seconds: float, *, within: int) -> bool:
        """Whether a key frame comes within so many frames after frame ``index``, if they go on as in this group."""
        if self._key is None:
            return False
        frames, seconds = index - self._key[0], pts_seconds - self._key[1]
        apart = seconds / frames if frames else 0.0
        return self._ends(frames + within, seconds + within * apart)

    @property
    def interval(self) -> int:
        """Frames of a group where none is left out."""
        return self._interval

    @property
    def least(self) -> int:
        """Frames that a group has however far apart they are."""
        return min(self._interval, LEAST_FRAMES)

    def ahead(self, index: int, pts_seconds: float, *, apart: float) -> Iterator[int]:
        """How many frames after frame ``index`` key frames come, rising, if frames go on ``apart`` seconds apart."""
        key_index, key_seconds = (index, pts_seconds) if self._key is None else self._key
        first = self._length(index - key_index, pts_seconds - key_seconds, apart)
        return count(first, self._length(0, 0.0, apart))

    def begin(self, index: int, pts_seconds: float) -> None:
        """Frame ``index`` is a key frame that has been written."""
        self._key = index, pts_seconds

    def _length(self, frames: int, seconds: float, apart: float) -> int:
        """How many frames later a group ends that has lasted so long."""
        return next(more for more in count(1) if self._ends(frames + more, seconds + more * apart))

    def _ends(self, frames: int, seconds: float) -> bool:
        """Whether a group that has lasted so long is followed by a key frame."""
        return frames >= self._interval or (frames >= LEAST_FRAMES and seconds >= self._seconds)
