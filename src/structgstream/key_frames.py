# SPDX-License-Identifier: Apache-2.0
"""Which frames begin a group that can be decoded without earlier packets.

Where no frame is left out that is every so many frames. A live run that leaves out pictures has few frames a second:
there the group ends when it has lasted as long as the same number of frames of the media, unless it would have fewer
than :data:`LEAST_FRAMES`, since key packets are several times as large as others.
"""

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
        """What frame ``index`` at ``pts_seconds`` is to be; it is remembered if it is a key frame."""
        if self._key is not None:
            frames, seconds = index - self._key[0], pts_seconds - self._key[1]
            lasted = frames >= LEAST_FRAMES and seconds >= self._seconds
            if frames < self._interval and not lasted:
                return PacketKind.DELTA
        self._key = index, pts_seconds
        return PacketKind.KEY

    def resume(self, index: int, pts_seconds: float) -> None:
        """The last key frame of the packets that are there already."""
        self._key = index, pts_seconds
