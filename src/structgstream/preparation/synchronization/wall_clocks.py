# SPDX-License-Identifier: Apache-2.0
"""Time stamps of files that share a clock: timecode, the time of creation, or stamps of one transmission.

Most files' stamps start at 0 when a camera starts and share no clock, so stamps are trusted only when the user asks
for it. Timecode counts frames, so it is good to a frame; it starts again at midnight, so cameras lie within half a day
of the first. A time of creation counts when it has a fraction of a second that is not 0 in some file: whole seconds are
30 frames. Stamps that start far from 0 are of a transmission (MPEG-TS, RTP) and hold as they are.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime

from structgstream.data.arrays import Floats
from structgstream.data.timeline import Clock
from structgstream.errors import CaptureError
from structgstream.preparation.synchronization.streams import period_seconds

FAR_FROM_ZERO_SECONDS = 10.0
CREATION_SIGMA_SECONDS = 0.05  # writing a file begins some frames before or after the first picture
_TIMECODE = re.compile(r"(\d{2}):(\d{2}):(\d{2})([:;.])(\d{2,3})")


@dataclass(frozen=True)
class WallClock:
    """A camera's clock by its file's stamps.

    Args:
        clock: the clock.
        sigma_seconds: how exact it is.
        kind: ``timecode``, ``creation time`` or ``stamps``.
    """

    clock: Clock
    sigma_seconds: float
    kind: str


def wall_clocks(stamps: Mapping[str, Floats], metadata: Mapping[str, Mapping[str, str]]) -> dict[str, WallClock]:
    """The clocks of all cameras by the best stamps that all their files have.

    Args:
        stamps: camera to the seconds ``[T]`` of its frames.
        metadata: camera to what its file states, by lower-case key.

    Raises:
        CaptureError: the files have no stamps of a common clock.
    """
    texts = {name: metadata.get(name, {}) for name in stamps}
    codes = {name: timecode(texts[name].get("timecode", ""), stamps[name]) for name in stamps}
    if all(code is not None for code in codes.values()):
        first = next(code.seconds for code in codes.values() if code is not None)
        starts = {name: code and code.nearest(first) for name, code in codes.items()}
        sigmas = {name: period_seconds(stamps[name]) / 12**0.5 for name in stamps}
        return _started(starts, stamps, sigmas, "timecode")
    created = {name: creation_seconds(texts[name].get("creation_time", "")) for name in stamps}
    if all(seconds is not None for seconds in created.values()) and any((s or 0.0) % 1 for s in created.values()):
        return _started(created, stamps, dict.fromkeys(stamps, CREATION_SIGMA_SECONDS), "creation time")
    if all(own[0] > FAR_FROM_ZERO_SECONDS for own in stamps.values()):
        return {name: WallClock(Clock(), 0.5e-3, "stamps") for name in stamps}
    lacking = next((name for name in stamps if codes[name] is None), "")
    raise CaptureError(
        f"The time stamps of the files share no clock: that of camera {lacking!r} has no timecode and not all state "
        "when they "
        "were made to fractions of a second, and their frames count from 0. Synchronise by audio, motion or "
        "timestamps.csv."
    )


@dataclass(frozen=True)
class Timecode:
    """A time of day by frames.

    Args:
        seconds: since midnight.
        day_seconds: of the frames from midnight to midnight; not 86,400 where timecode does not follow the clock.
    """

    seconds: float
    day_seconds: float

    def nearest(self, seconds: float) -> float:
        """The time in seconds, on the day on which it is nearest to ``seconds``."""
        return self.seconds + round((seconds - self.seconds) / self.day_seconds) * self.day_seconds


def timecode(text: str, stamps: Floats) -> Timecode | None:
    """The timecode ``HH:MM:SS:FF`` of frames at ``stamps`` ``[T]``, in seconds; None for other text.

    With a semicolon frames are dropped from the count so that it follows the clock at 29.97 and 59.94 frames a second
    (SMPTE ST 12-1): two, or four, at each minute that is no multiple of ten.
    """
    match = _TIMECODE.fullmatch(text.strip())
    if match is None:
        return None
    hours, minutes, seconds, frames = (int(match[group]) for group in (1, 2, 3, 5))
    rate = 1 / period_seconds(stamps)
    counted = round(rate)
    if frames >= counted or hours > 23 or minutes > 59 or seconds > 59:
        return None

    def at(whole: int) -> int:
        """Frames up to a minute of the day."""
        dropped = (counted // 15) * (whole - whole // 10) if match[4] in ";." else 0
        return whole * 60 * counted - dropped

    return Timecode((at(hours * 60 + minutes) + seconds * counted + frames) / rate, at(24 * 60) / rate)


def creation_seconds(text: str) -> float | None:
    """Seconds since 1970 of an ISO 8601 date and time; None for other text. Without a zone it is UTC."""
    try:
        moment = datetime.fromisoformat(text.strip())
    except ValueError:
        return None
    return (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()


def _started(
    starts: Mapping[str, float | None], stamps: Mapping[str, Floats], sigmas: Mapping[str, float], kind: str
) -> dict[str, WallClock]:
    """Clocks from the moments of the first frames; the earliest is the common second 0."""
    known = {name: seconds for name, seconds in starts.items() if seconds is not None}
    origin = min(known.values())
    return {
        name: WallClock(Clock(seconds - origin - float(stamps[name][0])), sigmas[name], kind)
        for name, seconds in known.items()
    }
