# SPDX-License-Identifier: Apache-2.0
"""Several qualities of one stream, fitted to the same frames by one process, which reads the cameras once.

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
from collections import deque
from collections.abc import Callable, Generator, Hashable, Mapping, Sequence
from contextlib import ExitStack, closing, suppress
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, Generic, TypeVar

from structgstream.cameras import CameraRig
from structgstream.codec.packets import PacketSink
from structgstream.codec.segments.manifest import MANIFEST
from structgstream.codec.segments.quality_list import (
    MAX_QUALITIES,
    ListedQuality,
    is_quality_name,
    read_list,
    write_list,
)
from structgstream.data.denoising import DenoisingConfig, denoised
from structgstream.data.sound import SoundSource
from structgstream.data.source import FrameStream, SharedFrames, read_ahead
from structgstream.errors import ConfigError, StorageError, StreamError
from structgstream.evaluation.run_log import append_log, begin_log, log_entry, read_log
from structgstream.frames import MultiViewFrame
from structgstream.kernels.backend import Backend
from structgstream.recorder import Run, RunMetrics, Storage, logged, with_sound
from structgstream.scene.scene import Scene
from structgstream.session.frame_report import FrameReport
from structgstream.session.loop import Session
from structgstream.session.pipeline import FrameTask, Past, Pipeline, StoredStream
from structgstream.session.presets import MAX_QUALITY, StreamConfig, with_budget
from structgstream.session.struct_gstream import FrameZeroContext, StructGStream, stream_pipeline
from structgstream.training.online.preprocess import FramePictures
from structgstream.training.result import FitResult, StepListener
from structgstream.training.views import View


@dataclass(frozen=True)
class Quality:
    """One of the qualities."""

    name: str  # name of its folder
    fineness: float  # online.rounding.quality: 0 is the preset's own, 1 halves most quantization steps


def qualities_in(given: Sequence[str]) -> tuple[Quality, ...]:
    """The qualities of texts such as ``low=-1``, the coarsest first, which viewers load first. Raises ConfigError if a
    text is malformed, two qualities have the same name or fineness, or their number is out of range."""
    qualities = sorted(map(_parsed, given), key=lambda quality: quality.fineness)
    if not 2 <= len(qualities) <= MAX_QUALITIES:
        raise ConfigError(
            f"--qualities takes 2 to {MAX_QUALITIES} qualities, which is what players choose from, got "
            f"{len(qualities)}; for a single one give --quality."
        )
    # Some file systems do not distinguish upper and lower case.
    for what, values in (("name", [q.name.lower() for q in qualities]), ("Q", [f"{q.fineness:g}" for q in qualities])):
        if twice := [one for one, other in pairwise(sorted(values)) if one == other]:
            raise ConfigError(
                f"--qualities has the {what} {twice[0]} twice; each quality needs a name and a Q of its own."
            )
    return tuple(qualities)


def configured(config: StreamConfig, quality: Quality) -> StreamConfig:
    """``config`` with a quality, as by ``--quality``. Raises ConfigError if the codec does not support qualities."""
    if config.codec != "compact":
        raise ConfigError(
            f"--qualities is for streams with the codec compact, got the codec {config.codec}; add --preset compact."
        )
    return with_budget(config, name=None, quality=quality.fineness, mbits=None)


def _parsed(text: str) -> Quality:
    name, _, number = text.partition("=")
    try:
        fineness = float(number)
    except ValueError:
        fineness = math.nan
    if not is_quality_name(name) or not abs(fineness) <= MAX_QUALITY:
        raise ConfigError(
            f"--qualities {text} is no quality; expected NAME=Q, a name of letters, digits, '-' and '_' and a Q from "
            f"{-MAX_QUALITY:g} to {MAX_QUALITY:g}, such as low=-1 or high=1."
        )
    return Quality(name, fineness)


EXPECTED_BITS = 2e6
"""Estimated bits per second of quality 0, from 1.9 and 2.9 Mbit/s in lab/notes/compact-measured.md. Each further unit
of quality doubles it."""
MIN_PACKETS = 5
MAX_PACKETS = 60
"""Number of packets over which a rate is measured: two groups of one second, or more if frames are skipped."""
CHANGE = 0.1
"""The list is rewritten when a rate differs from the listed one by this share."""


class BitRates:
    """Maintains the list of qualities in a folder."""

    def __init__(self, folder: Path, qualities: Sequence[Quality]) -> None:
        self._folder = folder
        self._listed = {quality.name: expected_bits(quality) for quality in qualities}
        self._packets = {quality.name: deque[tuple[float, int]](maxlen=MAX_PACKETS + 1) for quality in qualities}

    def begin(self, *, resume: bool) -> None:
        """Writes the list, with the rates of the earlier run if it is resumed. Raises StorageError if it cannot be
        written."""
        if resume:
            with suppress(StreamError):  # An unreadable list is replaced.
                listed = {one.name: one.bits_per_second for one in read_list(self._folder) or ()}
                self._listed |= {name: bits for name, bits in listed.items() if name in self._listed}
        self._write()

    def add(self, name: str, report: FrameReport) -> None:
        """Adds a stored frame of a quality to the measurement."""
        self._packets[name].append((report.pts_seconds, report.bytes))

    def refresh(self, *, last: bool = False) -> None:
        """Rewrites the list if a measured rate differs from the listed one. Raises StorageError if it cannot be
        written; the earlier list is not affected."""
        fewest, share = (1, 0.0) if last else (MIN_PACKETS, CHANGE)
        known = {
            name: bits
            for name, packets in self._packets.items()
            if len(packets) > fewest and (bits := bits_per_second(packets)) is not None
        }
        if any(abs(bits - self._listed[name]) > share * self._listed[name] for name, bits in known.items()):
            self._listed |= known
            self._write()

    def _write(self) -> None:
        listed = [ListedQuality(name, f"{name}/{MANIFEST}", round(bits)) for name, bits in self._listed.items()]
        write_list(self._folder, listed)


def expected_bits(quality: Quality) -> float:
    """Estimated bits per second of a quality before any measurement; only the order of qualities is reliable."""
    return EXPECTED_BITS * 2.0**quality.fineness


def bits_per_second(packets: Sequence[tuple[float, int]]) -> float | None:
    """Bits per second of media, at least 1, from times and sizes of packets; None if they have the same time.

    The first packet only marks the start time; its bytes do not count, because frame 0's packet is nearly empty.
    """
    seconds = packets[-1][0] - packets[0][0]
    return max(8 * sum(size for _, size in [*packets][1:]) / seconds, 1.0) if seconds > 0 else None


Value = TypeVar("Value")
PICTURES_KEPT = 3
"""Results of the current frame, the next one, which may be read ahead, and the previous one, if a quality lacks it."""


class Once(Generic[Value]):
    """The last ``most`` values, each computed at its first request, one at a time. Thread-safe."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._found: dict[Hashable, Value] = {}
        self._lock = threading.Lock()

    def value(self, key: Hashable, make: Callable[[], Value]) -> tuple[Value, bool]:
        """The value of ``key``, and whether it was computed now."""
        with self._lock:
            if key in self._found:
                return self._found[key], False
            while len(self._found) >= self._most:
                del self._found[next(iter(self._found))]
            value = self._found[key] = make()
            return value, True

    def clear(self) -> None:
        """Removes all values."""
        with self._lock:
            self._found.clear()


@dataclass(frozen=True)
class SharedMethod(StructGStream):
    """The method of one of several qualities, with the results that all share (Note [Shared work])."""

    # preprocessed pictures, by the number of a frame and whether they are compared with the frame before
    pictures: Once[FramePictures] = field(default_factory=lambda: Once(PICTURES_KEPT))
    first_fits: Once[FitResult[Scene]] = field(default_factory=lambda: Once(1))  # by frame number

    def observe(
        self, frame: MultiViewFrame, before: Sequence[View] | None, *, rig: CameraRig, backend: Backend
    ) -> FramePictures:
        key = frame.index, before is None
        observe = super().observe
        return self.pictures.value(key, lambda: observe(frame, before, rig=rig, backend=backend))[0]

    def first(self, task: FrameTask) -> FitResult[Scene]:
        """See ``StructGStream``; only the quality that computed the fit reports its seconds."""
        first = super().first
        fit, mine = self.first_fits.value(task.frame.index, lambda: first(task))
        return fit if mine else replace(fit, seconds={})

    def next(self, past: Past[Scene, FrameZeroContext], task: FrameTask) -> FitResult[Scene]:
        if task.begins is None:  # All qualities have the previous frame, so no first frame is needed again.
            self.first_fits.clear()
        return super().next(past, task)


FIGURES = ("kind", "bytes", "train_psnr", "total_seconds", "cpu_seconds", "anchors", "free", "begins")
"""Keys that a line of the joint log contains for each quality, copied from that quality's own log."""


def joint_report(reports: Mapping[str, FrameReport]) -> FrameReport:
    """Bytes and seconds summed over the qualities, without ``field_bytes`` and ``train_psnr``; all other values are
    those of the last of ``reports``."""
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
    """One line of the run's log, from the frame's line in the log of each quality, also of those that had the frame
    already."""
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
    sound: SoundSource | None = None,
) -> Run:
    """Reconstructs a capture in several qualities (Note [In step]), with a log of each quality and of the run.

    The call checks existing streams, starts the logs and writes the list of qualities; streams are written as the
    reports are consumed.

    Args:
        folder: contains ``qualities.json`` and a folder for each quality; logs are next to these.
        qualities: at least one, the coarsest first.
        sound: what each stores beside the frames; None for nothing.

    Raises:
        ConfigError: a stream to resume was made with another configuration or from another capture.
        StreamError: a stream to resume is damaged so that it cannot be continued.
        StorageError: a stream, a log or the list cannot be written; complete frames are not affected.
    """
    method = SharedMethod(config)
    opened, stated = [], metadata
    for quality in qualities:
        sink, stored = storages[quality.name](resume)
        if sound is not None:
            sink, stated = with_sound(sink, metadata, sound, source=source, resumed=stored)
        own = configured(config, quality)
        # Frames are denoised below, once for all qualities.
        pipeline = replace(stream_pipeline(own), method=replace(method, config=own), denoising=DenoisingConfig())
        opened.append(_Opened(quality.name, pipeline, sink, stored))
    shown = read_ahead(denoised(source, config.denoising))
    frames = SharedFrames(shown, starts=[one.start for one in opened], first=[one.first for one in opened])
    reports = {}
    for one, reader in zip(opened, frames.readers, strict=True):
        session = Session(reader, one.sink, one.pipeline, backend, resumed=one.stored, metadata=stated, on_step=on_step)
        begin_log(folder / one.name, frames=one.done)
        reports[one.name] = logged(session.run(), folder / one.name)
    done = {one.name: one.done for one in opened}
    rates, least = BitRates(folder, qualities), min(done.values())
    rates.begin(resume=resume)
    begin_log(folder, frames=least)
    return Run(least, _reported(_in_step(reports, done, frames.close), folder, [*done], rates, metrics))


def _in_step(
    reports: Mapping[str, Generator[FrameReport, None, None]], done: Mapping[str, int], close: Callable[[], object]
) -> Generator[QualityReport, None, None]:
    """The reports of all sessions; always advances the one with the fewest frames (Note [In step])."""
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
