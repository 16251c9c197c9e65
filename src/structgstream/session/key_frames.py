# SPDX-License-Identifier: Apache-2.0
"""Selection of key frames, each of which begins a group that can be decoded without earlier packets.

Without skipped frames a key frame comes at a constant interval of frames. A live run that skips pictures has fewer
frames per second. Its groups end after the duration of that interval, but not before they have :data:`MIN_FRAMES`
frames, because key packets are several times as large as others.
"""

from collections.abc import Iterator
from itertools import count

from structgstream.codec.packets import PacketKind

MIN_FRAMES = 5
_SAME = 0.5  # tolerance in frames, because times of frames jitter


class KeyFrames:
    """Follows a stream's packets and decides the kind of the next one.

    Args:
        interval: frames of a group without skipped frames.
        fps: frames per second of the media.
    """

    def __init__(self, interval: int, fps: float) -> None:
        self._interval, self._seconds = interval, (interval - _SAME) / fps
        self._key: tuple[int, float] | None = None

    def kind(self, index: int, pts_seconds: float) -> PacketKind:
        """The kind of the packet of frame ``index`` at ``pts_seconds``."""
        if self._key is None:
            return PacketKind.KEY
        return PacketKind.KEY if self._ends(index - self._key[0], pts_seconds - self._key[1]) else PacketKind.DELTA

    def near(self, index: int, pts_seconds: float, *, within: int) -> bool:
        """Whether a key frame comes within ``within`` frames after frame ``index``, at the frame rate of this group."""
        if self._key is None:
            return False
        frames, seconds = index - self._key[0], pts_seconds - self._key[1]
        spacing = seconds / frames if frames else 0.0
        return self._ends(frames + within, seconds + within * spacing)

    @property
    def interval(self) -> int:
        """Frames of a group without skipped frames."""
        return self._interval

    @property
    def least(self) -> int:
        """Smallest number of frames in a group."""
        return min(self._interval, MIN_FRAMES)

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
        return frames >= self._interval or (frames >= MIN_FRAMES and seconds >= self._seconds)
