# SPDX-License-Identifier: Apache-2.0
"""Sound of cameras, live ones too, and of separate recorders: as samples to synchronise by, and as Opus packets in
presentation time.

Note [Sound in step]
~~~~~~~~~~~~~~~~~~~~
Sample 0 of what is encoded sounds with frame 0, whatever frames follow, so a resumed run encodes the same packets. A
file's clock gives the presentation time of its samples; where the clock's rate is not 1 the samples are resampled, so
that ten minutes later they are still in step. Gaps in the time stamps become silence.
"""

import logging
import math
import threading
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from fractions import Fraction
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from structgstream.data.source import EveryNthFrame, FrameSource, Section, SourceWrapper, innermost
from structgstream.data.timeline import Clock
from structgstream.data.video import VideoSource
from structgstream.data.video_index import load_av
from structgstream.errors import CaptureError, ConfigError
from structgstream.opus import PACKET_SAMPLES, PACKET_SECONDS, SAMPLE_RATE, OpusPacket

if TYPE_CHECKING:
    from av.audio.frame import AudioFrame
    from av.audio.stream import AudioStream

log = logging.getLogger(__name__)

LONGEST_SECONDS = 7200.0
BITS_PER_SECOND = {1: 64_000, 2: 96_000}
"""Of Opus by number of channels: hardly distinguishable from the original."""
GAP_SECONDS = 0.03
"""Difference of a time stamp from the samples before it above which something is missing, or comes twice."""
SAME_RATE = 1e-7
"""Rates of clocks that differ from 1 by less count as 1: 0.4 ms in an hour."""
RATE_FACTOR = 1000  # Rates in hertz are whole numbers; those of clocks differ from 1 by millionths.
MAX_EARLY = 4096
"""Frames of sound that wait for the first set of pictures, which states when presentation begins; 87 s of AAC."""
MAX_WAITING = 2**16 - 1
"""Packets that wait for the next frame: 21 minutes, as many as it can have."""
MAX_SILENCE_SECONDS = 10.0
"""After a longer gap sound begins again instead of being silent that long."""


class SoundFeed(Protocol):
    """The sound of one run."""

    @property
    def channels(self) -> int: ...

    def until(self, seconds: float) -> list[OpusPacket]:
        """The packets that begin before a presentation time and were not taken before."""
        ...


class SoundSource(Protocol):
    """Sound to store with a stream."""

    @property
    def name(self) -> str:
        """The camera or file that it comes from; a stream is resumed with the same."""
        ...

    def open(self) -> SoundFeed:
        """The sound from the beginning; a run of several qualities opens it for each."""
        ...


class SoundEncoder:
    """Frames of PyAV to Opus packets in presentation time (Note [Sound in step]).

    Args:
        channels: 1 or 2; others are mixed.
        rate: of the clock of the frames.
        start_seconds: presentation time of the first sample; what is earlier is left out.
    """

    def __init__(self, channels: int, *, rate: float = 1.0, start_seconds: float = 0.0) -> None:
        av = load_av()
        self._layout = "mono" if channels == 1 else "stereo"
        self._channels = channels
        self._rate = rate if abs(rate - 1.0) > SAME_RATE else 1.0
        self._resampler: Any = None
        self._of: tuple[int, str, str] | None = None  # rate, layout and sample format of the frames
        self._base = 0.0  # presentation time of the first sample of the resampler
        self._taken = self._given = 0  # samples that the resampler has taken and given
        self._start = self._at = round(start_seconds * SAMPLE_RATE)  # samples from presentation time 0 on
        codec = av.CodecContext.create("libopus", "w")
        codec.sample_rate, codec.layout, codec.format = SAMPLE_RATE, self._layout, "flt"
        codec.bit_rate = BITS_PER_SECOND[channels]
        codec.time_base = Fraction(1, SAMPLE_RATE)
        codec.options = {"application": "audio", "frame_duration": str(round(1000 * PACKET_SECONDS))}
        codec.open()
        self._codec: Any = codec

    def add(self, frame: "AudioFrame", seconds: float | None) -> list[OpusPacket]:
        """The packets that are complete with another frame, whose first sample sounds at ``seconds`` of presentation
        time; None where it follows the one before."""
        kind = frame.sample_rate, frame.layout.name, frame.format.name
        packets: list[OpusPacket] = []
        if kind != self._of:
            packets = self._flush()
            self._begin(kind, 0.0 if seconds is None else seconds)
        if seconds is not None:
            gap = seconds - self._base - self._rate * self._taken / kind[0]
            self._base += gap if abs(gap) > GAP_SECONDS else 0.0
        self._taken += frame.samples
        if self._rate != 1.0:
            frame.sample_rate = kind[0] * RATE_FACTOR
        frame.pts = None
        return packets + self._resampled(frame)

    def finish(self) -> list[OpusPacket]:
        """The last packets; the last one ends with silence."""
        return self._flush() + self._silence((self._start - self._at) % PACKET_SAMPLES) + self._encoded(None)

    def _begin(self, kind: tuple[int, str, str], seconds: float) -> None:
        factor = 1 if self._rate == 1.0 else RATE_FACTOR
        rate = round(SAMPLE_RATE * self._rate * factor)
        self._resampler = load_av().AudioResampler(format="flt", layout=self._layout, rate=rate)
        self._of, self._base, self._taken, self._given = kind, seconds, 0, 0

    def _flush(self) -> list[OpusPacket]:
        return [] if self._resampler is None else self._resampled(None)

    def _resampled(self, frame: "AudioFrame | None") -> list[OpusPacket]:
        packets: list[OpusPacket] = []
        for part in self._resampler.resample(frame):
            samples = part.to_ndarray().reshape(-1, self._channels)
            packets += self._placed(samples, round((self._base + self._given / SAMPLE_RATE) * SAMPLE_RATE))
            self._given += len(samples)
        return packets

    def _placed(self, samples: NDArray[np.float32], first: int) -> list[OpusPacket]:
        """Samples of which the first is number ``first`` from presentation time 0 on."""
        missing = first - self._at
        if missing > 1:  # One is rounding.
            return self._silence(missing) + self._following(samples)
        return self._following(samples[-missing:] if missing < -1 else samples)

    def _silence(self, count: int) -> list[OpusPacket]:
        packets: list[OpusPacket] = []
        for start in range(0, count, SAMPLE_RATE):
            packets += self._following(np.zeros((min(count - start, SAMPLE_RATE), self._channels), np.float32))
        return packets

    def _following(self, samples: NDArray[np.float32]) -> list[OpusPacket]:
        if not len(samples):
            return []
        frame = load_av().AudioFrame.from_ndarray(samples.reshape(1, -1), format="flt", layout=self._layout)
        frame.sample_rate, frame.pts, frame.time_base = SAMPLE_RATE, self._at, Fraction(1, SAMPLE_RATE)
        self._at += len(samples)
        return self._encoded(frame)

    def _encoded(self, frame: "AudioFrame | None") -> list[OpusPacket]:
        """Complete packets: the encoder divides frames of any length."""
        return [OpusPacket(packet.pts / SAMPLE_RATE, bytes(packet)) for packet in self._codec.encode(frame)]


@dataclass(frozen=True)
class SoundFile:
    """The sound of a file."""

    name: str  # of the camera, or of the file
    path: Path  # of the file
    clock: Clock  # from seconds of the file to presentation times

    def open(self) -> "FileFeed":
        """See :class:`SoundSource`. Raises CaptureError if the file cannot be opened, or has no sound."""
        with open_sound(self.path) as container:
            stream = sound_stream(container, self.path)
            return FileFeed(self, min(stream.codec_context.channels, 2))


class FileFeed:
    """Encodes a file as far as it is asked for."""

    def __init__(self, source: SoundFile, channels: int) -> None:
        self.channels = channels
        self._source = source
        self._packets = self._encoded()
        self._next: OpusPacket | None = None
        self._end: float | None = None  # presentation time at which the packets that were taken end
        self._reported = False

    def until(self, seconds: float) -> list[OpusPacket]:
        """See :class:`SoundFeed`."""
        found = []
        for packet in self._packets if self._next is None else chain([self._next], self._packets):
            self._next = packet
            if packet.seconds >= seconds:
                return found
            found.append(packet)
            self._end = packet.seconds + PACKET_SECONDS
        self._next = None
        if not self._reported and (self._end is None or self._end + PACKET_SECONDS < seconds):
            self._reported = True
            log.warning(
                "The sound of %s ends %s; what follows is silent", self._source.name,
                "before these frames" if self._end is None else f"at {self._end:.1f} s, before the pictures",
            )  # fmt: skip
        return found

    def _encoded(self) -> Iterator[OpusPacket]:
        source = self._source
        encoder = SoundEncoder(self.channels, rate=source.clock.rate)
        av = load_av()
        with open_sound(source.path) as container:
            frames = container.decode(sound_stream(container, source.path))
            try:
                for frame in frames:
                    time = None if frame.time is None else source.clock.offset_seconds + source.clock.rate * frame.time
                    yield from encoder.add(frame, time)
            except (av.error.FFmpegError, ValueError) as error:  # The pictures go on.
                log.warning(
                    "The sound of %s cannot be decoded any further (%s); what follows is silent", source.path, error
                )  # fmt: skip
                self._reported = True
        yield from encoder.finish()


class LiveSound:
    """The sound of one live camera, mixed to one channel, encoded as it arrives; thread-safe."""

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


def sound_stream(container: Any, path: Path) -> "AudioStream":
    """The sound of an opened file. Raises CaptureError if it has none."""
    if not container.streams.audio:
        raise CaptureError(f"{path} has no sound; choose another camera or file with --sound.")
    if (count := len(container.streams.audio)) > 1:
        log.warning("%s has %d sound tracks; the first is taken", path, count)
    return container.streams.audio[0]


def has_sound(path: Path) -> bool:
    """Whether a file has sound. Raises CaptureError if it cannot be opened."""
    with open_sound(path) as container:
        return bool(container.streams.audio)


def camera_clock(source: FrameSource, camera: str) -> tuple[Path, Clock] | None:
    """The video of a camera, and the clock from its seconds to presentation times; None without a video. Raises
    ConfigError as :func:`start_seconds`."""
    filmed = innermost(source)
    if not isinstance(filmed, VideoSource) or camera not in filmed.tracks:
        return None
    track, stamps = filmed.tracks[camera], filmed.stamps[camera]
    shown = np.flatnonzero([stamp is not None for stamp in stamps])
    if not len(shown):
        return None
    own = (np.array([stamps[i] for i in shown], np.float64) - track.origin) * track.tick_seconds
    apart = filmed.apart_seconds.get(camera, np.zeros(len(stamps)))[shown]
    common = shown / filmed.fps + apart
    rate = float((common[-1] - common[0]) / (own[-1] - own[0])) if len(own) > 1 else 1.0
    rate = rate if abs(rate - 1.0) > SAME_RATE else 1.0
    return track.path, Clock(float(np.mean(common - rate * own)) + start_seconds(source), rate)


def start_seconds(source: FrameSource) -> float:
    """Presentation time of the first frame of the whole capture: not above 0. Raises ConfigError if frames are not
    shown at the rate at which they were filmed."""
    if not isinstance(source, SourceWrapper):
        return 0.0
    if isinstance(source, EveryNthFrame) and source.rate is not None:
        raise ConfigError("Frames that are not shown at the rate of the capture have no sound.")
    earlier = source.first / source.source.fps if isinstance(source, Section) else 0.0
    return start_seconds(source.source) - earlier


def camera_videos(source: FrameSource) -> dict[str, Path]:
    """The videos of a capture's cameras, by name; nothing for pictures."""
    inner = innermost(source)
    return {name: track.path for name, track in inner.tracks.items()} if isinstance(inner, VideoSource) else {}


class SoundDecoder:
    """Decodes the sound of frames in order."""

    def __init__(self, channels: int) -> None:
        self._channels = channels
        self._codec: Any = None
        self._end = 0.0

    def decode(self, packets: Sequence[bytes], seconds: float) -> NDArray[np.float32]:
        """Samples ``[N, channels]`` in [-1, 1] at 48 kHz of packets whose first sample sounds at ``seconds``."""
        av = load_av()
        parts = [np.zeros((0, self._channels), np.float32)]
        if self._codec is None or (packets and abs(seconds - self._end) > PACKET_SECONDS / 2):
            self._codec = av.CodecContext.create("opus", "r")
            self._codec.sample_rate, self._codec.layout = SAMPLE_RATE, "mono" if self._channels == 1 else "stereo"
        for packet in packets:
            parts += [frame.to_ndarray().T for frame in self._codec.decode(av.Packet(packet))]
        self._end = seconds + len(packets) * PACKET_SECONDS
        return np.concatenate(parts)


@contextmanager
def open_sound(path: Path) -> Iterator[Any]:
    """An opened file, of which only the sound is read. Raises CaptureError if it is missing, or holds nothing that can
    be read."""
    av = load_av()
    try:
        container = av.open(str(path), metadata_errors="replace")
    except (av.error.FFmpegError, OSError) as error:
        raise CaptureError(
            f"The sound of {path} cannot be read, because the file cannot be opened ({error.strerror}); copy or record "
            "it again."
        ) from None
    with container:
        yield container


def read_audio(path: Path) -> NDArray[np.float32] | None:
    """Mono samples ``[N]`` in [-1, 1] at 48 kHz; sample 0 sounds at 0 s of the video's time stamps.

    Where the sound starts later than time 0, silence precedes it; gaps in the time stamps become silence, and what
    comes twice is left out. None when the file has no sound.

    Raises:
        CaptureError: the file cannot be read, or is longer than two hours.
    """
    av = load_av()
    with open_sound(path) as container:
        if not container.streams.audio:
            return None
        stream = container.streams.audio[0]
        resampler = av.AudioResampler(format="flt", layout="mono", rate=SAMPLE_RATE)
        parts: list[NDArray[np.float32]] = []
        start_seconds: float | None = None
        end_seconds = 0.0  # of the samples so far
        try:
            for frame in container.decode(stream):
                seconds = end_seconds if frame.time is None else float(frame.time)
                if start_seconds is None:
                    start_seconds = end_seconds = seconds
                gap = seconds - end_seconds
                if gap < -GAP_SECONDS:
                    continue
                if gap > GAP_SECONDS:
                    if seconds > LONGEST_SECONDS:
                        raise _too_long(path)
                    parts.append(np.zeros(round(gap * SAMPLE_RATE), np.float32))
                    end_seconds = seconds
                end_seconds += frame.samples / frame.sample_rate
                parts += [resampled.to_ndarray()[0] for resampled in resampler.resample(frame)]
            parts += [resampled.to_ndarray()[0] for resampled in resampler.resample(None)]
        except (av.error.FFmpegError, ValueError) as error:  # The latter where channels or rate change.
            raise CaptureError(
                f"The sound of {path} cannot be decoded ({getattr(error, 'strerror', error)}); copy the file "
                "again, or synchronise by another method."
            ) from None
    if not parts or start_seconds is None:
        return None
    samples = np.concatenate(parts)
    parts.clear()  # two hours are 1.4 GB
    first = round(start_seconds * SAMPLE_RATE)
    if len(samples) + first > LONGEST_SECONDS * SAMPLE_RATE:
        raise _too_long(path)
    return np.concatenate([np.zeros(first, np.float32), samples]) if first > 0 else samples[-first:]


def _too_long(path: Path) -> CaptureError:
    return CaptureError(f"{path} is longer than two hours; cut it to the take.")
