# SPDX-License-Identifier: Apache-2.0
"""What a run does now: in a small file beside the stream for programs that watch it, and in the lines of its log.

``OUT.metrics.json`` is written anew every few seconds and after each frame, whole or not at all. Numbers have their
units in their names; what is not known is null. ``docs/live.md`` lists the keys.
"""

import json
import math
import os
import shutil
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict
from enum import StrEnum
from pathlib import Path
from typing import Any

from structgstream.data.live.status import LiveStatus
from structgstream.errors import StorageError
from structgstream.frame_report import FrameReport
from structgstream.memory import resident_bytes
from structgstream.whole_files import side_path, write_whole

FORMAT, VERSION = "structgstream-metrics", 1
BEAT_SECONDS = 2.0
RATES = ("frames_in_per_second", "frames_out_per_second", "bits_per_second")
RECENT = 30  # frames over which rates are taken


class RunState(StrEnum):
    """Where a run is."""

    WAITING = "waiting"  # for the first frame
    RUNNING = "running"
    FINISHED = "finished"
    FAILED = "failed"


def metrics_path(stream: Path) -> Path:
    """The path of a stream's metrics."""
    return side_path(stream, ".metrics.json")


class Figures:
    """What the last frames of a stream, or of all qualities of one, took.

    Args:
        fps: frames a second of the media.
    """

    def __init__(self, fps: float) -> None:
        self._fps = fps
        self._recent: deque[FrameReport] = deque(maxlen=RECENT)
        self._bytes = 0

    def add(self, report: FrameReport) -> None:
        """Takes a frame's report."""
        self._recent.append(report)
        self._bytes += report.bytes

    @property
    def frames(self) -> int | None:
        """How many there are up to the newest one; None before the first report."""
        return self._recent[-1].index + 1 if self._recent else None

    def values(self) -> dict[str, Any]:
        """Sizes, times and Gaussians, as plain JSON values; what is not known is None."""
        last = self._recent[-1] if self._recent else None
        return {
            "pts_seconds": None if last is None else last.pts_seconds,
            "bytes": self._bytes,
            "bits_per_second": _bit_rate([*self._recent], self._fps),
            "seconds_by_stage": _mean([report.seconds for report in self._recent]),
            "train_psnr": None if last is None or not math.isfinite(last.train_psnr) else last.train_psnr,
            "anchors": None if last is None else last.anchors,
            "free": None if last is None else last.free,
        }


class RunMetrics:
    """Collects what a run does.

    Args:
        stream: the file or folder that the run writes.
        fps: frames a second of the media.
        total: number of frames, None where it is unknown.
        done: number of frames that were there before.
        live: what live cameras do; None for a recording.
        captured: when a frame was filmed, Unix time, by its number; None where that is not known.
        qualities: names of those that the run makes of each frame; none where it makes one stream.
        now: monotonic seconds.
        unix: Unix time.
    """

    def __init__(
        self,
        stream: Path,
        *,
        fps: float,
        total: int | None = None,
        done: int = 0,
        live: Callable[[], LiveStatus] | None = None,
        captured: Callable[[int], float | None] | None = None,
        qualities: Sequence[str] = (),
        now: Callable[[], float] = time.monotonic,
        unix: Callable[[], float] = time.time,
    ) -> None:
        self._stream, self._fps, self._total, self._done = stream, fps, total, done
        self._live, self._captured, self._now, self._unix = live, captured, now, unix
        self._age: float | None = None
        self._begun = now()
        self._state = RunState.WAITING
        self._figures = Figures(fps)
        self._absent: list[str] | None = None
        self._qualities = {name: Figures(fps) for name in qualities}
        self._stored: deque[tuple[float, int]] = deque(maxlen=RECENT)
        self._arrived: deque[tuple[float, int]] = deque(maxlen=RECENT)
        self._lock, self._writing = threading.Lock(), threading.Lock()

    def quality(self, name: str, report: FrameReport) -> None:
        """Takes a frame's report of one of the qualities, before that of the whole frame."""
        with self._lock:
            self._qualities[name].add(report)

    def frame(self, report: FrameReport) -> dict[str, Any]:
        """Takes a frame's report, of all qualities; what its line of the log gets besides, if the run is live."""
        with self._lock:
            self._state = RunState.RUNNING
            self._figures.add(report)
            self._stored.append((self._now(), report.index))
            self._absent = list(report.absent)
            self._done = report.index + 1
            filmed = None if self._captured is None else self._captured(report.index)
            self._age = None if filmed is None else self._unix() - filmed
        self.write()
        if self._live is None:
            return {}
        taken = self.values()
        keys = (*RATES, "stored_after_seconds", "disk_free_bytes", "resident_bytes", "live")
        return {"run": {key: taken[key] for key in keys}}

    def values(self) -> dict[str, Any]:
        """Everything, as plain JSON values."""
        live = None if self._live is None else self._live()
        with self._lock:
            now, figures = self._now(), self._figures.values()
            if live is not None:
                self._arrived.append((now, live.sets))
            several: dict[str, Any] = {}
            if self._qualities:  # Gaussians and decibels are those of a quality.
                figures |= {"train_psnr": None, "anchors": None, "free": None}
                each = {name: {"frames": own.frames, **own.values()} for name, own in self._qualities.items()}
                several["qualities"] = each
            return {
                "format": FORMAT,
                "version": VERSION,
                "stream": self._stream.name,
                "state": self._state.value,
                "process": os.getpid(),
                "updated_unix_seconds": self._unix(),
                "running_seconds": now - self._begun,
                "frames": self._done,
                "frames_total": self._total,
                "fps": self._fps,
                "frames_in_per_second": None if live is None else _rate([*self._arrived]),
                "frames_out_per_second": _rate([*self._stored]),
                "stored_after_seconds": self._age,
                **figures,
                "absent": self._absent,
                "disk_free_bytes": free_bytes(self._stream),
                "resident_bytes": resident_bytes(),
                "live": None if live is None else asdict(live),
                **several,
            }

    def write(self) -> None:
        """Writes the file. A full disk is not told here: the stream itself will."""
        content = f"{json.dumps(self.values(), allow_nan=False)}\n".encode()
        with self._writing, suppress(StorageError):
            write_whole(metrics_path(self._stream), content, sync=False)

    @contextmanager
    def running(self) -> Iterator[None]:
        """Writes the file every few seconds, and once more with how the run ended."""
        stop = threading.Event()

        def beat() -> None:
            self.write()
            while not stop.wait(BEAT_SECONDS):
                self.write()

        thread = threading.Thread(target=beat, name="metrics", daemon=True)
        thread.start()
        ended = RunState.FAILED
        try:
            yield
            ended = RunState.FINISHED
        except KeyboardInterrupt:
            ended = RunState.FINISHED
            raise
        finally:
            stop.set()
            thread.join()
            self._state = ended
            self.write()


def free_bytes(path: Path) -> int | None:
    """Room on the disk of a file that may not be there yet; None where that is not known."""
    for folder in (path, *path.absolute().parents):
        if folder.exists():
            with suppress(OSError):
                return shutil.disk_usage(folder).free
    return None


def _rate(counted: list[tuple[float, int]]) -> float | None:
    """What was counted a second."""
    if len(counted) < 2 or counted[-1][0] <= counted[0][0]:
        return None
    return (counted[-1][1] - counted[0][1]) / (counted[-1][0] - counted[0][0])


def _bit_rate(reports: list[FrameReport], fps: float) -> float | None:
    """Bits a second of media; where frames were skipped a second of media has fewer."""
    if not reports:
        return None
    seconds = reports[-1].pts_seconds - reports[0].pts_seconds + 1 / fps
    return 8 * sum(report.bytes for report in reports) / seconds


def _mean(stages: list[Mapping[str, float]]) -> dict[str, float]:
    names = dict.fromkeys(name for own in stages for name in own)
    return {name: sum(own.get(name, 0.0) for own in stages) / len(stages) for name in names}
