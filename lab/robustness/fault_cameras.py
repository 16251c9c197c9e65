# SPDX-License-Identifier: Apache-2.0
"""Cameras that go wrong, for ``faults``: what the trainer gets of them, and for how long that is not as it was.

Cameras are a process that sends coded pictures; they are decoded, matched and kept as in any live run. What stands for
the trainer looks at each picture of each frame, and writes a prepared packet.
"""

import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from enum import StrEnum
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lab.robustness.fault_film import Film, Moment, film_of, pictures, write_film
from lab.robustness.stream_writers import Sent, edge_of, readable
from structgstream.codec.segments.sink import SegmentsSink
from structgstream.codec.segments.store import FolderStore
from structgstream.data.live.source import LiveSource
from structgstream.frames import MultiViewFrame

FILMED = ("cut", "silent", "stuck", "garbage", "size", "shape", "jump", "back", "jitter", "duplicate", "reorder")
COUNTED = {
    "cut": "gone", "silent": "gone", "stuck": "stuck", "garbage": "garbage", "size": "other size",
    "shape": "other size", "jump": "jump", "back": "jump", "duplicate": "duplicate", "reorder": "reordered",
}  # fmt: skip
MAX_ERROR = 400.0
"""Mean square of 255 levels from a picture as it was filmed, coded; a block elsewhere makes ten times as much."""
STEADY_FRAMES = 5
SAMPLED = 2  # every so many pixels are compared


class State(StrEnum):
    """What a frame has of a camera."""

    RIGHT = "right"
    ABSENT = "absent"
    SMEARED = "smeared"  # no picture of the film
    APART = "apart"  # of another instant than most cameras'


@dataclass(frozen=True)
class Seen:
    """A frame.

    Args:
        at: Unix time at which the trainer had it.
        states: of each camera.
        counts: of faults until then, by camera and kind.
    """

    at: float
    states: Mapping[str, State]
    counts: Mapping[str, Mapping[str, int]]


@dataclass
class CameraRow:
    """A kind of fault, at many moments.

    Attributes:
        moments: how many.
        seed: of them.
        frames: that the trainer got.
        reported_frames_lost: that were reported as written and are not in the stream.
        smeared: pictures handed to the trainer that no camera filmed.
        apart: those of another instant than the others' of the frame.
        counted: moments that the run's counters have under the kind of the fault.
        absent_frames: of each moment.
        seconds_until_absent: from the first wrong picture.
        seconds_until_normal: from the first right picture after the fault until :data:`STEADY_FRAMES` frames in a row
            have a right one.
        never_normal: moments that were not over when the camera's next began.
        others: pictures of cameras with which nothing was wrong.
        others_lacking: of them, absent or wrong.
        longest_gap_seconds: between two frames.
    """

    what: str
    moments: int = 0
    seed: int = 0
    frames: int = 0
    reported_frames_lost: int = 0
    smeared: int = 0
    apart: int = 0
    counted: int = 0
    absent_frames: list[int] = field(default_factory=list)
    seconds_until_absent: list[float] = field(default_factory=list)
    seconds_until_normal: list[float] = field(default_factory=list)
    never_normal: int = 0
    others: int = 0
    others_lacking: int = 0
    longest_gap_seconds: float = 0.0


class Viewer:
    """Tells which picture of the film a picture is."""

    def __init__(self) -> None:
        self._film = pictures()[:, ::SAMPLED, ::SAMPLED].astype(np.float32)

    def number(self, image: NDArray[np.uint8]) -> int | None:
        """Its number; None if it is none of them."""
        errors = np.square(self._film - image[::SAMPLED, ::SAMPLED]).mean((1, 2, 3))
        best = int(errors.argmin())
        return best if errors[best] < MAX_ERROR else None

    def states(self, frame: MultiViewFrame, cameras: Sequence[str]) -> dict[str, State]:
        """What the frame has of each camera."""
        numbers = {name: self.number(image) for name, image in frame.images.items()}
        known = Counter(number for number in numbers.values() if number is not None)
        (most, _), *_ = known.most_common(1) or [(None, 0)]

        def state(name: str) -> State:
            if name not in numbers:
                return State.ABSENT
            if numbers[name] is None:
                return State.SMEARED
            return State.RIGHT if numbers[name] == most else State.APART

        return {name: state(name) for name in cameras}


@contextmanager
def sending(folder: Path) -> Iterator[float]:
    """A process that sends a film until the end of the block; the Unix time of picture 0."""
    command = [sys.executable, "-m", "lab.robustness.fault_film", str(folder)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as running:
        assert running.stdout is not None
        try:
            yield float(running.stdout.readline())
        finally:
            running.kill()


def seen_of(film: Film, sent: Sent, folder: Path) -> tuple[list[Seen], float, int]:
    """All frames of a live run of the film, the Unix time of its picture 0, and how many reported frames were lost."""
    write_film(folder / "film", film)
    store, viewer, found = FolderStore(folder / "stream"), Viewer(), []
    store.prepare()
    sink = SegmentsSink(store)
    sink.open(sent.header)
    with sending(folder / "film") as begun, LiveSource(folder / "film" / "rig.toml", folder / "stream") as source:
        for frame, packet in zip(source.frames(), sent.packets, strict=False):
            at = time.time()
            found.append(Seen(at, viewer.states(frame, film.cameras), source.faults.counts))
            sink.write(packet)
            if at > begun + film.seconds:
                break
    lost = max(len(found) - 1 - edge_of(store.folder), 0)
    sink.close()
    assert readable(store.folder, sent.whole), "what was written is a beginning of what was sent"
    return found, begun, lost


def camera_faults(fault: str, sent: Sent, *, moments: int, seed: int, folder: Path) -> CameraRow:
    """Cameras that go wrong in one way, at random moments."""
    film = film_of(fault, moments=moments, seed=seed)
    seen, begun, lost = seen_of(film, sent, folder)
    return replace(camera_row(film, seen, begun=begun, lost=lost), seed=seed)


def camera_row(film: Film, seen: Sequence[Seen], *, begun: float, lost: int) -> CameraRow:
    """What became of the moments of a film, all of which have one kind of fault."""
    row = CameraRow(film.moments[0].fault, moments=len(film.moments), frames=len(seen), reported_frames_lost=lost)
    row.longest_gap_seconds = max(later.at - one.at for one, later in pairwise(seen))
    wrong: dict[str, list[tuple[float, float]]] = {name: [] for name in film.cameras}
    for moment in film.moments:
        wrong[moment.camera].append(_follow(row, film, moment, seen, begun))
    for one in seen:
        if one.at < begun + film.moments[0].start - 1.0:
            continue
        for name, state in one.states.items():
            row.smeared += state is State.SMEARED
            row.apart += state is State.APART
            if not any(first <= one.at <= last for first, last in wrong[name]):
                row.others += 1
                row.others_lacking += state is not State.RIGHT
    return row


def _follow(row: CameraRow, film: Film, moment: Moment, seen: Sequence[Seen], begun: float) -> tuple[float, float]:
    """A moment's part of the row; from when until when its camera was not as before, Unix time."""
    first, last = (begun + at for at in film.span(moment))
    limit = min(
        (begun + other.start for other in film.moments if other.camera == moment.camera and other.start > moment.start),
        default=float("inf"),
    )
    inside = [one for one in seen if first <= one.at < limit]
    states = [one.states[moment.camera] for one in inside]
    row.absent_frames.append(states.count(State.ABSENT))
    if State.ABSENT in states:
        row.seconds_until_absent.append(inside[states.index(State.ABSENT)].at - first)
    kind = COUNTED.get(moment.fault)
    if kind is not None and inside:
        before = next((one for one in reversed(seen) if one.at < first), inside[0])
        row.counted += _count(inside[-1], moment, kind) > _count(before, moment, kind)
    for index, one in enumerate(inside):
        steady = states[index : index + STEADY_FRAMES]
        if one.at >= last and steady == [State.RIGHT] * STEADY_FRAMES:
            row.seconds_until_normal.append(one.at - last)
            return first, one.at
    row.never_normal += 1
    return first, min(limit, seen[-1].at)


def _count(seen: Seen, moment: Moment, kind: str) -> int:
    return seen.counts.get(moment.camera, {}).get(kind, 0)
