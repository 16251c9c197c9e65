# SPDX-License-Identifier: Apache-2.0
"""Metrics of a run: a small file next to the stream for monitoring, and entries in the lines of its log.

``OUT.metrics.json`` is rewritten atomically every few seconds and after each frame. Names of numbers contain their
units; unknown values are null. ``docs/live.md`` lists the keys.
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

from structgstream.atomic_files import atomic_write, side_path
from structgstream.data.live.status import LiveStatus
from structgstream.errors import StorageError
from structgstream.memory import resident_bytes
from structgstream.session.frame_report import FrameReport

FORMAT, VERSION = "structgstream-metrics", 1
BEAT_SECONDS = 2.0
RATES = ("frames_in_per_second", "frames_out_per_second", "bits_per_second")
RECENT = 30  # number of frames over which rates are measured


class RunState(StrEnum):
    """State of a run."""

    WAITING = "waiting"  # for the first frame
    RUNNING = "running"
    FINISHED = "finished"
    FAILED = "failed"


def metrics_path(stream: Path) -> Path:
    """The path of a stream's metrics."""
    return side_path(stream, ".metrics.json")


class Figures:
    """Statistics of the last frames of a stream, or of all its qualities."""

    def __init__(self, fps: float) -> None:
        self._fps = fps
        self._recent: deque[FrameReport] = deque(maxlen=RECENT)
        self._bytes = 0

    def add(self, report: FrameReport) -> None:
        """Add a frame's report."""
        self._recent.append(report)
        self._bytes += report.bytes

    @property
    def frames(self) -> int | None:
        """Number of frames up to the newest one; None before the first report."""
        return self._recent[-1].index + 1 if self._recent else None

    def values(self) -> dict[str, Any]:
        """Sizes, times and numbers of Gaussians, as plain JSON values; None if unknown."""
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
    """Collects and writes the metrics of a run.

    Args:
        captured: returns the time of capture of a frame by its index, Unix time; None if unknown.
        qualities: names of the qualities of each frame; empty for a single stream.
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
        """Add a frame's report of one of the qualities; called before :meth:`frame`."""
        with self._lock:
            self._qualities[name].add(report)

    def frame(self, report: FrameReport) -> dict[str, Any]:
        """Add a frame's report of all qualities; returns further entries of its line in the log if the run is live."""
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
        """All metrics, as plain JSON values."""
        live = None if self._live is None else self._live()
        with self._lock:
            now, figures = self._now(), self._figures.values()
            if live is not None:
                self._arrived.append((now, live.sets))
            several: dict[str, Any] = {}
            if self._qualities:  # Numbers of Gaussians and PSNR belong to a single quality.
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
        """Writes the file. A full disk is not reported here, because writing the stream will fail and report it."""
        content = f"{json.dumps(self.values(), allow_nan=False)}\n".encode()
        with self._writing, suppress(StorageError):
            atomic_write(metrics_path(self._stream), content, sync=False)

    @contextmanager
    def running(self) -> Iterator[None]:
        """Writes the file every few seconds, and at the end with the final state of the run."""
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
    """Free space on the disk of a file that may not exist yet; None if unknown."""
    for folder in (path, *path.absolute().parents):
        if folder.exists():
            with suppress(OSError):
                return shutil.disk_usage(folder).free
    return None


def _rate(counted: list[tuple[float, int]]) -> float | None:
    """Increase of a counter per second."""
    if len(counted) < 2 or counted[-1][0] <= counted[0][0]:
        return None
    return (counted[-1][1] - counted[0][1]) / (counted[-1][0] - counted[0][0])


def _bit_rate(reports: list[FrameReport], fps: float) -> float | None:
    """Bits per second of media time, including the time of skipped frames."""
    if not reports:
        return None
    seconds = reports[-1].pts_seconds - reports[0].pts_seconds + 1 / fps
    return 8 * sum(report.bytes for report in reports) / seconds


def _mean(stages: list[Mapping[str, float]]) -> dict[str, float]:
    names = dict.fromkeys(name for own in stages for name in own)
    return {name: sum(own.get(name, 0.0) for own in stages) / len(stages) for name in names}
