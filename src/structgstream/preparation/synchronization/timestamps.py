# SPDX-License-Identifier: Apache-2.0
"""``timestamps.csv``: when frames were taken, by a clock that all cameras share.

A header ``camera,frame,seconds`` and a row for each frame that is known: the camera's name, the frame's number in its
video counted from 0, and the second. One row a camera is enough (the frame of a clap, seconds 0); two or more that
are apart give its rate, too.
"""

import csv
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from structgstream.data.arrays import Floats
from structgstream.data.text_files import Unreadable, number, read_text, reason, whole
from structgstream.data.timeline import Clock
from structgstream.errors import CaptureError
from structgstream.preparation.synchronization.streams import period_seconds

COLUMNS = ("camera", "frame", "seconds")
MAX_DEVIATION = 0.5  # of a row from a steady clock, in frame periods
RATE_ROWS = 2
MAX_DRIFT = 0.01


@dataclass(frozen=True)
class StatedClock:
    """A camera's clock by the rows of the table, and the spread of these around it, in seconds."""

    clock: Clock
    spread_seconds: float


def read_timestamps(file: Path, stamps: Mapping[str, Floats]) -> dict[str, StatedClock]:
    """The clocks that a table states.

    Args:
        file: the table.
        stamps: camera to the seconds ``[T]`` of all its frames by its own clock.

    Raises:
        CaptureError: the file cannot be read, lacks a camera or names a frame that its camera does not have, or its
        times do
            not follow the frames.
    """
    rows = _rows(file)
    clocks = {}
    for name, own in stamps.items():
        if name not in rows:
            others = ", ".join(repr(other) for other in sorted(rows)) or "none"
            raise CaptureError(
                f"{file} has no row for camera {name!r}; it has cameras {others}. Add a row of one of its frames, "
                "or remove "
                "the camera."
            )
        clocks[name] = _clock(file, name, rows[name], own)
    return clocks


def _rows(file: Path) -> dict[str, dict[int, float]]:
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
    for row in reader:
        try:
            name, frame, seconds = str(row["camera"]).strip(), whole(row["frame"]), number(row["seconds"])
        except Unreadable:
            raise CaptureError(
                f"Line {reader.line_num} of {file} is not a camera, a frame number and seconds; correct or remove it."
            ) from None
        if frame in rows.setdefault(name, {}):
            raise CaptureError(f"{file} has two times for frame {frame} of camera {name!r}; keep one of them.")
        rows[name][frame] = seconds
    return rows


def _clock(file: Path, name: str, rows: Mapping[int, float], stamps: Floats) -> StatedClock:
    frames = np.array(sorted(rows))
    seconds = np.array([rows[frame] for frame in frames.tolist()])
    if frames[0] < 0 or frames[-1] >= len(stamps):
        wrong = frames[0] if frames[0] < 0 else frames[-1]
        raise CaptureError(
            f"{file} has a time for frame {wrong} of camera {name!r}, whose frames are 0 to {len(stamps) - 1}; "
            "frames count "
            "from 0. Correct the numbers, or give the whole video."
        )
    own, period = stamps[frames], period_seconds(stamps)
    rate = 1.0
    if len(frames) >= RATE_ROWS and own[-1] - own[0] > 0:
        rate = float(np.polyfit(own - own.mean(), seconds, 1)[0])
        # What rounding of the rows could be is no drift.
        if abs(rate - 1) * (own[-1] - own[0]) < 1e-3:
            rate = 1.0
    if abs(rate - 1) > MAX_DRIFT:
        raise CaptureError(
            f"By {file} the clock of camera {name!r} runs {rate:.4g} times as fast as its video; frames lack in the "
            "video or in "
            "the numbers of frames, or the rate of the video is wrong."
        )
    offset = float(np.mean(seconds - rate * own))
    off = seconds - offset - rate * own
    worst = int(np.abs(off).argmax())
    if abs(off[worst]) > MAX_DEVIATION * period:
        raise CaptureError(
            f"By {file} frame {frames[worst]} of camera {name!r} is {abs(off[worst]):.4f} s off a steady clock, "
            "more than half a "
            f"frame period ({period / 2:.4f} s); frames lack in the video, or numbers in the table are wrong."
        )
    return StatedClock(Clock(offset, rate), float(np.std(off)))
