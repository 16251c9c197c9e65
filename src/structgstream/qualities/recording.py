# SPDX-License-Identifier: Apache-2.0
"""Records several qualities of one stream frame by frame, reading the cameras once, with a joint report of each frame.

Note [In step]
~~~~~~~~~~~~~~
Each quality is a session of its own, equal to that of a run with a single quality. The session with the fewest frames
is always advanced next, the coarsest first among equals. So all sessions receive the same frames (Note [Readers]), and
they differ by at most one frame when the process is killed. After resuming, a quality that lacks a frame gets it before
any other continues.

Note [Shared work]
~~~~~~~~~~~~~~~~~~
Qualities differ in quantization steps and in the weight of the rate term. Neither affects the preprocessing of
pictures, nor the fit of frame 0 (or of a period that begins from points), which is quantized only afterwards. So each
of these is computed for the first quality that requests it, and the others receive the same values; their bytes equal
those of separate runs. Qualities fit a frame one after the other, so only the latest results are cached.
"""

import math
import threading
from collections import OrderedDict
from collections.abc import Callable, Generator, Hashable, Mapping, Sequence
from concurrent.futures import Future
from contextlib import ExitStack, closing, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Generic, TypeVar

from structgstream.cameras import CameraRig
from structgstream.codec.packets import PacketSink
from structgstream.data.denoising import DenoisingConfig, denoised
from structgstream.data.shared_frames import SharedFrames
from structgstream.data.source import FrameStream
from structgstream.data.wrappers import read_ahead
from structgstream.errors import StorageError
from structgstream.evaluation.run_log import append_log, begin_log, log_entry, read_log
from structgstream.frames import MultiViewFrame
from structgstream.kernels.backend import Backend
from structgstream.qualities.ladder import BitRates, Quality, configured
from structgstream.recorder import Storage, log_reports
from structgstream.run_metrics import RunMetrics
from structgstream.scene.scene import Scene
from structgstream.session.frame_report import FrameReport
from structgstream.session.loop import Session
from structgstream.session.pipeline import FrameTask, Past, Pipeline, StoredStream
from structgstream.session.presets import StreamConfig
from structgstream.session.struct_gstream import FrameZeroContext, StructGStream, stream_pipeline
from structgstream.training.online.preprocess import FramePictures
from structgstream.training.result import FitResult, StepListener

Value = TypeVar("Value")
PICTURES_KEPT = 3
"""Results of the current frame, the next one, which may be read ahead, and the previous one, if a quality lacks it."""


class Once(Generic[Value]):
    """A cache that computes each value at its first request; concurrent requests wait for it. Thread-safe.

    Args:
        most: largest number of cached values.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._found: OrderedDict[Hashable, Future[Value]] = OrderedDict()
        self._lock = threading.Lock()

    def value(self, key: Hashable, make: Callable[[], Value]) -> tuple[Value, bool]:
        """The value of ``key``, and whether it was computed now. All waiting requests receive an error of ``make``."""
        with self._lock:
            found = self._found.get(key)
            mine = found is None
            if found is None:
                found = self._found[key] = Future()
                while len(self._found) > self._most:
                    self._found.popitem(last=False)
        if mine:
            try:
                found.set_result(make())
            except BaseException as error:
                found.set_exception(error)
                self._forget(key)
        return found.result(), mine

    def clear(self) -> None:
        """Removes all values."""
        with self._lock:
            self._found.clear()

    def _forget(self, key: Hashable) -> None:
        with self._lock:
            self._found.pop(key, None)


@dataclass(frozen=True)
class SharedWork:
    """Shared results of the qualities of one run."""

    # preprocessed pictures, by the numbers of a frame and of the frame before
    pictures: Once[FramePictures] = field(default_factory=lambda: Once(PICTURES_KEPT))
    first: Once[FitResult[Scene]] = field(default_factory=lambda: Once(1))  # fits of first frames, by frame number


@dataclass(frozen=True)
class SharedMethod(StructGStream):
    """The method of one of several qualities (Note [Shared work])."""

    shared: SharedWork = field(default_factory=SharedWork)  # the shared results

    def observe(
        self, frame: MultiViewFrame, before: MultiViewFrame | None, *, rig: CameraRig, backend: Backend
    ) -> FramePictures:
        """See ``StructGStream``."""
        key = frame.index, None if before is None else before.index
        observe = super().observe
        return self.shared.pictures.value(key, lambda: observe(frame, before, rig=rig, backend=backend))[0]

    def first(self, task: FrameTask) -> FitResult[Scene]:
        """See ``StructGStream``; only the quality that computed the fit reports its seconds."""
        first = super().first
        fit, mine = self.shared.first.value(task.frame.index, lambda: first(task))
        return fit if mine else replace(fit, seconds={})

    def next(self, past: Past[Scene, FrameZeroContext], task: FrameTask) -> FitResult[Scene]:
        """See ``StructGStream``."""
        if task.begins is None:  # All qualities have the previous frame, so no first frame is needed again.
            self.shared.first.clear()
        return super().next(past, task)


def shared_pipeline(config: StreamConfig, shared: SharedWork) -> Pipeline[Scene, Any]:
    """The pipeline of one of several qualities.

    Raises:
        ConfigError: see ``stream_pipeline``.
    """
    return replace(stream_pipeline(config), method=SharedMethod(config, shared=shared))


FIGURES = ("kind", "bytes", "train_psnr", "total_seconds", "cpu_seconds", "anchors", "free", "begins")
"""Keys that a line of the joint log contains for each quality, copied from that quality's own log."""


def joint_report(reports: Mapping[str, FrameReport]) -> FrameReport:
    """The sums of bytes and seconds; all other values are those of the finest quality, the last."""
    each = [*reports.values()]
    stages = dict.fromkeys(name for report in each for name in report.seconds)
    return replace(
        each[-1],
        bytes=sum(report.bytes for report in each),
        field_bytes={},
        train_psnr=math.nan,
        seconds={name: sum(report.seconds.get(name, 0.0) for report in each) for name in stages},
        cpu_seconds=sum(report.cpu_seconds for report in each),
    )


def joint_entry(report: FrameReport, entries: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """One line of the run's log.

    Args:
        report: joint report of all qualities that were fitted now.
        entries: the frame's line in the log of each quality, by name, including qualities that had the frame already.
    """
    each = {name: {key: entry[key] for key in FIGURES if key in entry} for name, entry in entries.items()}
    return {
        "index": report.index,
        "pts_seconds": report.pts_seconds,
        "bytes": sum(entry.get("bytes", 0) for entry in each.values()),
        "total_seconds": report.seconds["total"],
        **({"absent": list(report.absent)} if report.absent else {}),
        "qualities": each,
    }


@dataclass(frozen=True)
class QualityReport:
    """Report of a stored frame of a quality."""

    quality: str  # name of the quality
    report: FrameReport  # report of the frame
    whole: bool  # whether all qualities have the frame now


@dataclass(frozen=True)
class QualitiesRun:
    """A reconstruction into several qualities."""

    done: int  # number of frames that all qualities had at the start
    # reports of the further frames; each step of the generator fits, stores and logs one frame of one quality
    reports: Generator[QualityReport, None, None]


@dataclass(frozen=True)
class _Opened:
    """An opened quality: its name, pipeline and sink, and its existing frames."""

    name: str
    pipeline: Pipeline[Scene, Any]
    sink: PacketSink
    stored: StoredStream[Scene] | None

    @property
    def done(self) -> int:
        return 0 if self.stored is None else len(self.stored)

    @property
    def start(self) -> int:
        """The first frame that its session reads: the one before the next, if changes since then are needed."""
        return max(self.done - self.pipeline.method.needs_before, 0)

    @property
    def first(self) -> int:
        """The first frame of its period, which a resumed session reads again."""
        return 0 if self.stored is None or not self.done else self.stored.period(self.done - 1).first_frame


def record_qualities(
    folder: Path,
    source: FrameStream,
    config: StreamConfig,
    qualities: Sequence[Quality],
    backend: Backend,
    *,
    storages: Mapping[str, Storage[Scene]],
    resume: bool = False,
    metadata: Mapping[str, object] | None = None,
    on_step: StepListener | None = None,
    metrics: RunMetrics | None = None,
) -> QualitiesRun:
    """Reconstructs a capture in several qualities (Note [In step]), with a log of each quality and of the run.

    The call checks existing streams, starts the logs and writes the list of qualities; streams are written as the
    reports are consumed.

    Args:
        folder: contains ``qualities.json`` and a folder for each quality; logs are next to these.
        config: configuration of all qualities, without their fineness.
        qualities: at least one, the coarsest first.
        storages: opens the sink of each quality, by name.
        resume: continue after the last complete frame of each quality.
        metadata: plain JSON values for the headers.
        metrics: receives every frame; has these qualities.

    Raises:
        ConfigError: a stream to resume was made with another configuration or from another capture.
        StreamError: a stream to resume is damaged so that it cannot be continued.
        StorageError: a stream, a log or the list cannot be written; complete frames are not affected.
    """
    work = SharedWork()
    opened = []
    for quality in qualities:
        sink, stored = storages[quality.name](resume)
        # Frames are denoised below, once for all qualities.
        pipeline = replace(shared_pipeline(configured(config, quality), work), denoising=DenoisingConfig())
        opened.append(_Opened(quality.name, pipeline, sink, stored))
    starts, firsts = [one.start for one in opened], [one.first for one in opened]
    shown = read_ahead(denoised(source, config.denoising))
    frames = SharedFrames(shown, starts=starts, first=firsts)
    reports = {}
    for one, reader in zip(opened, frames.readers, strict=True):
        session = Session(
            reader, one.sink, one.pipeline, backend, resumed=one.stored, metadata=metadata, on_step=on_step
        )
        reports[one.name] = log_reports(session.run(), folder / one.name, done=one.done)
    done = {one.name: one.done for one in opened}
    rates, least = BitRates(folder, qualities), min(done.values())
    rates.begin(resume=resume)
    begin_log(folder, frames=least)
    return QualitiesRun(least, _reported(_in_step(reports, done, frames.close), folder, [*done], rates, metrics))


def _in_step(
    reports: Mapping[str, Generator[FrameReport, None, None]], done: Mapping[str, int], close: Callable[[], object]
) -> Generator[QualityReport, None, None]:
    """The reports of all sessions; always advances the one with the fewest frames (Note [In step]).

    Args:
        reports: reports of each session, by name; closed with the result.
        done: number of frames of each session.
    """
    frames, going = dict(done), [*reports]
    with ExitStack() as stack:
        stack.callback(close)
        for own in reports.values():
            stack.enter_context(closing(own))
        while going:
            name = min(going, key=frames.__getitem__)
            report = next(reports[name], None)
            if report is None:
                going.remove(name)
                continue
            frames[name] = report.index + 1
            yield QualityReport(name, report, min(frames.values()) > report.index)


def _reported(
    reports: Generator[QualityReport, None, None],
    folder: Path,
    names: Sequence[str],
    rates: BitRates,
    metrics: RunMetrics | None,
) -> Generator[QualityReport, None, None]:
    """The reports, each added to the list, the metrics and the run's log before it is yielded."""
    now: dict[str, FrameReport] = {}
    try:
        with closing(reports):
            for one in reports:
                now[one.quality] = one.report
                rates.add(one.quality, one.report)
                if metrics is not None:
                    metrics.quality(one.quality, one.report)
                if one.whole:
                    rates.refresh()
                    joint = joint_report(now)
                    further = {} if metrics is None else metrics.frame(joint)
                    append_log(folder, joint_entry(joint, _lines(folder, names, now)) | further)
                    now = {}
                yield one
    finally:
        with suppress(StorageError):  # The error that ended the run must be raised instead.
            rates.refresh(last=True)


def _lines(folder: Path, names: Sequence[str], now: Mapping[str, FrameReport]) -> dict[str, Mapping[str, Any]]:
    """A frame's entry in the log of each quality; read from the log for qualities that had it before the run."""
    (index,) = {report.index for report in now.values()}
    lines = {name: log_entry(now[name]) if name in now else read_log(folder / name).get(index) for name in names}
    return {name: line for name, line in lines.items() if line is not None}
