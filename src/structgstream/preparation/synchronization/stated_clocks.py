# SPDX-License-Identifier: Apache-2.0
"""Clocks that files state: a table of times, timecode, the time of creation, or stamps of one transmission.

``timestamps.csv`` states when frames were taken, by a clock that all cameras share: a header ``camera,frame,seconds``
and a row for each frame that is known: the camera's name, the frame's number in its video counted from 0, and the
second. One row a camera is enough (the frame of a clap, seconds 0); two or more give its rate, too, where they are so
far apart that rounding is no explanation.

Most files' stamps start at 0 when a camera starts and share no clock, so stamps are trusted only on request. Timecode
counts frames, so it is good to a frame; it starts again at midnight, so cameras lie within half a day of the first. A
time of creation counts when it has a fraction of a second that is not 0 in some file: whole seconds are 30 frames.
Stamps that start far from 0 are of a transmission (MPEG-TS, RTP) and hold as they are.
"""

import csv
import re
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from decimal import Decimal
from pathlib import Path

import numpy as np

from structgstream.data.text_files import Unreadable, number, read_text, reason, whole
from structgstream.data.timeline import Clock, counted_rate, period_seconds
from structgstream.errors import CaptureError
from structgstream.geometry import Floats

COLUMNS = ("camera", "frame", "seconds")
MAX_DEVIATION = 0.5  # of a row from a steady clock, in frame periods
MAX_DRIFT = 0.01
MIN_DRIFT_SECONDS, MIN_DRIFT_UNITS = 1e-3, 2.0
"""Between a camera's first and last row, the latter in units of the last decimal: less may be rounding, no drift."""


@dataclass(frozen=True)
class StatedClock:
    """A camera's clock as files state it."""

    clock: Clock  # the clock
    sigma_seconds: float  # how exact it is; of a table, the spread of its rows
    kind: str  # ``table``, ``timecode``, ``creation time`` or ``stamps``


def read_timestamps(file: Path, stamps: Mapping[str, Floats]) -> dict[str, StatedClock]:
    """The clocks that a table states for cameras whose frames are at ``stamps`` ``[T]``, seconds by their own clocks.

    Raises:
        CaptureError: the file cannot be read, lacks a camera or names a frame that its camera does not have, or its
            times do not follow the frames.
    """
    rows, unit = _rows(file)
    clocks = {}
    for name, own in stamps.items():
        if name not in rows:
            others = ", ".join(repr(other) for other in sorted(rows)) or "none"
            raise CaptureError(
                f"{file} has no row for camera {name!r}; it has cameras {others}. Add a row of one of its frames, "
                "or remove the camera."
            )
        clocks[name] = _clock(file, name, rows[name], own, least=max(MIN_DRIFT_SECONDS, MIN_DRIFT_UNITS * unit))
    return clocks


def _rows(file: Path) -> tuple[dict[str, dict[int, float]], float]:
    """The second of each frame of each camera, and that of the last decimal; writers leave out zeros, so it is that of
    the row with most decimals."""
    try:
        lines = read_text(file).splitlines()
    except (OSError, Unreadable) as error:
        raise CaptureError(
            f"{file} cannot be read ({reason(error)}); expected a text with {','.join(COLUMNS)}."
        ) from None
    header = lines[0] if lines else ""
    separator = next((mark for mark in ";\t" if mark in header), ",")  # semicolons, where commas are decimal
    reader = csv.DictReader(lines, skipinitialspace=True, delimiter=separator)
    missing = [column for column in COLUMNS if column not in (reader.fieldnames or ())]
    if missing:
        raise CaptureError(
            f"{file} lacks the column {missing[0]!r}; its first line must name the columns {','.join(COLUMNS)}."
        )
    rows: dict[str, dict[int, float]] = {}
    unit = 1.0
    for row in reader:
        if any(row.get(None, ())):
            raise CaptureError(
                f"Line {reader.line_num} of {file} has more cells than its first line; write decimal points, or "
                "semicolons between cells."
            )
        try:
            name, frame, seconds = str(row["camera"]).strip(), whole(row["frame"]), number(row["seconds"])
        except Unreadable:
            raise CaptureError(
                f"Line {reader.line_num} of {file} is not a camera, a frame number and seconds; correct or remove it."
            ) from None
        if frame in rows.setdefault(name, {}):
            raise CaptureError(f"{file} has two times for frame {frame} of camera {name!r}; keep one of them.")
        rows[name][frame] = seconds
        unit = min(unit, 10.0 ** int(Decimal(row["seconds"].strip().replace(",", ".")).as_tuple().exponent))
    return rows, unit


def _clock(file: Path, name: str, rows: Mapping[int, float], stamps: Floats, *, least: float) -> StatedClock:
    """The clock by a camera's rows; a drift of less than ``least`` seconds from the first to the last is none."""
    frames = np.array(sorted(rows))
    seconds = np.array([rows[frame] for frame in frames.tolist()])
    if frames[0] < 0 or frames[-1] >= len(stamps):
        wrong = frames[0] if frames[0] < 0 else frames[-1]
        raise CaptureError(
            f"{file} has a time for frame {wrong} of camera {name!r}, whose frames are 0 to {len(stamps) - 1}; "
            "frames count from 0. Correct the numbers, or give the whole video."
        )
    own, period = stamps[frames], period_seconds(stamps)
    rate = 1.0
    if own[-1] > own[0]:
        rate = float(np.polyfit(own - own.mean(), seconds, 1)[0])
        if abs(rate - 1) * (own[-1] - own[0]) < least:
            rate = 1.0
    if abs(rate - 1) > MAX_DRIFT:
        raise CaptureError(
            f"By {file} the clock of camera {name!r} runs {rate:.4g} times as fast as its video; frames are missing "
            "from the video or from the frame numbers, or the rate of the video is wrong."
        )
    offset = float(np.mean(seconds - rate * own))
    off = seconds - offset - rate * own
    worst = int(np.abs(off).argmax())
    if abs(off[worst]) > MAX_DEVIATION * period:
        raise CaptureError(
            f"By {file} frame {frames[worst]} of camera {name!r} is {abs(off[worst]):.4f} s off a steady clock, "
            f"more than half a frame period ({period / 2:.4f} s); frames are missing from the video, or numbers in "
            "the table are wrong."
        )
    return StatedClock(Clock(offset, rate), float(np.std(off)), "table")


FAR_FROM_ZERO_SECONDS = 10.0
CREATION_SIGMA_SECONDS = 0.05  # writing a file begins some frames before or after the first picture
_TIMECODE = re.compile(r"(\d{2}):(\d{2}):(\d{2})([:;.])(\d{2,3})")


def wall_clocks(stamps: Mapping[str, Floats], metadata: Mapping[str, Mapping[str, str]]) -> dict[str, StatedClock]:
    """The clocks of all cameras, with frames at ``stamps`` ``[T]``, by the best stamps that all their files have.

    ``metadata`` is by camera what its file states, by lower-case key.

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
        return {name: StatedClock(Clock(), 0.5e-3, "stamps") for name in stamps}
    lacking = next((name for name in stamps if codes[name] is None), "")
    raise CaptureError(
        f"The time stamps of the files share no clock: that of camera {lacking!r} has no timecode and not all state "
        "when they were made to fractions of a second, and their frames count from 0. Synchronise by audio, motion or "
        "timestamps.csv."
    )


@dataclass(frozen=True)
class Timecode:
    """A time of day by frames."""

    seconds: float  # since midnight
    day_seconds: float  # of the frames from midnight to midnight; not 86,400 where timecode does not follow the clock

    def nearest(self, seconds: float) -> float:
        """The time in seconds, on the day on which it is nearest to ``seconds``."""
        return self.seconds + round((seconds - self.seconds) / self.day_seconds) * self.day_seconds


def timecode(text: str, stamps: Floats) -> Timecode | None:
    """The timecode ``HH:MM:SS:FF`` of frames at ``stamps`` ``[T]``, in seconds; None for other text.

    With a semicolon frames are dropped from the count so that it follows the clock at 29.97 and 59.94 frames a second
    (SMPTE ST 12-1): two, or four, at each minute that is no multiple of ten.

    The rate is a whole number, or 1000/1001 of one: by that which the stamps have, rounded as they are in Matroska,
    ten hours would be off by minutes.
    """
    match = _TIMECODE.fullmatch(text.strip())
    if match is None:
        return None
    hours, minutes, seconds, frames = (int(match[group]) for group in (1, 2, 3, 5))
    measured = counted_rate([stamps]) or 30.0
    counted = round(measured)
    rate = min((counted, counted * 1000 / 1001), key=lambda nominal: abs(nominal - measured))
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
) -> dict[str, StatedClock]:
    """Clocks from the moments of the first frames; the earliest is the common second 0."""
    known = {name: seconds for name, seconds in starts.items() if seconds is not None}
    origin = min(known.values())
    return {
        name: StatedClock(Clock(seconds - origin - float(stamps[name][0])), sigmas[name], kind)
        for name, seconds in known.items()
    }
