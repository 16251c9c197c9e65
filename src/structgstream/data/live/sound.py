# SPDX-License-Identifier: Apache-2.0
"""The sound of a live camera: encoded as it arrives, in step with the camera's pictures."""

import logging
import math
import threading
from collections import deque
from typing import TYPE_CHECKING

from structgstream.data.sound import SoundEncoder
from structgstream.opus import OpusPacket

if TYPE_CHECKING:
    from av.audio.frame import AudioFrame

log = logging.getLogger(__name__)

MAX_EARLY = 4096
"""Frames of sound that wait for the first set of pictures, which states when presentation begins; 87 s of AAC."""
MAX_WAITING = 2**16 - 1
"""Packets that wait for the next frame: 21 minutes, as many as it can have."""
MAX_SILENCE_SECONDS = 10.0
"""After a longer gap sound begins again instead of being silent that long."""


class LiveSound:
    """The sound of one camera, mixed to one channel; thread-safe.

    Args:
        camera: its name.
    """

    channels = 1

    def __init__(self, camera: str) -> None:
        self.name = camera
        self._lock = threading.Lock()
        self._feeds: list[LiveFeed] = []
        self._early: deque[tuple[AudioFrame, float]] = deque(maxlen=MAX_EARLY)
        self._encoder: SoundEncoder | None = None
        self._origin: float | None = None
        self._end = -math.inf  # presentation time up to which there is sound

    def open(self) -> "LiveFeed":
        """See ``SoundSource``: what arrives from now on."""
        feed = LiveFeed()
        with self._lock:
            self._feeds.append(feed)
        return feed

    def synchronize(self, origin: float) -> None:
        """States the common clock at presentation time 0, with each frame: a clock may be reset."""
        with self._lock:
            self._origin = origin
            while self._early:
                self._encode(*self._early.popleft())

    def add(self, frame: "AudioFrame", seconds: float) -> None:
        """A frame of sound whose first sample was heard at ``seconds`` on the common clock."""
        with self._lock:
            if self._origin is None:
                self._early.append((frame, seconds))
            else:
                self._encode(frame, seconds)

    def _encode(self, frame: "AudioFrame", seconds: float) -> None:
        assert self._origin is not None
        begin = seconds - self._origin
        end = begin + frame.samples / frame.sample_rate
        if end <= 0:
            return
        if self._encoder is None or begin - self._end > MAX_SILENCE_SECONDS:
            self._encoder = SoundEncoder(self.channels, start_seconds=max(begin, 0.0))
        packets = self._encoder.add(frame, begin)
        self._end = max(self._end, end)
        for feed in self._feeds:
            feed.add(packets)


class LiveFeed:
    """What has arrived and was not taken yet; thread-safe, as a deque is."""

    channels = LiveSound.channels

    def __init__(self) -> None:
        self._packets: deque[OpusPacket] = deque(maxlen=MAX_WAITING)

    def add(self, packets: list[OpusPacket]) -> None:
        """Further packets."""
        self._packets.extend(packets)

    def until(self, seconds: float) -> list[OpusPacket]:
        """See ``SoundFeed``."""
        found = []
        while self._packets and self._packets[0].seconds < seconds:
            found.append(self._packets.popleft())
        return found
