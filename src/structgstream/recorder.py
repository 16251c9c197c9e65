# SPDX-License-Identifier: Apache-2.0
"""Writes a stream, its log and its metrics frame by frame; used by commands and the Python API.

``OUT.metrics.json``, for monitoring, is rewritten atomically every few seconds and after each frame. Names of numbers
contain their units; unknown values are null. ``docs/live.md`` lists the keys.
"""

import json
import math
import os
import threading
import time
from collections import deque
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from structgstream.atomic_files import atomic_write, side_path
from structgstream.codec.container.byte_source import free_bytes
from structgstream.codec.packets import Packet, PacketKind, PacketSink, StreamHeader
from structgstream.codec.reader import StreamReader
from structgstream.codec.scene_coder import SceneDecoder
from structgstream.codec.segments.manifest import MANIFEST
from structgstream.codec.segments.sink import Clocks, SegmentsOptions, SegmentsSink
from structgstream.codec.segments.store import FolderStore, Store
from structgstream.codec.segments.stored_bytes import read_manifest
from structgstream.codec.sinks import StoredSegments, resume_segments
from structgstream.codec.sound import SoundFormat, frame_sound
from structgstream.data.live.status import LiveStatus
from structgstream.data.sound import SoundSource
from structgstream.data.source import FrameStream, frame_count, read_ahead
from structgstream.errors import StorageError, StreamError
from structgstream.evaluation.pictures import png_bytes
from structgstream.evaluation.run_log import append_log, begin_log, log_entry
from structgstream.kernels.backend import Backend, processor_backend
from structgstream.memory import resident_bytes
from structgstream.scene.render import render_picture
from structgstream.scene.scene import Scene
from structgstream.session.frame_report import FrameReport
from structgstream.session.loop import Session
from structgstream.session.pipeline import Memory, Pipeline, State, StoredStream
from structgstream.training.result import StepListener

Storage = Callable[[bool], tuple[PacketSink, StoredStream[State] | None]]
"""Opens a sink. If called with True, the existing stream is resumed and its reader is returned, too."""
LogExtras = Callable[[FrameReport], Mapping[str, Any]]
"""Further entries of a frame's line in the log."""


@dataclass(frozen=True)
class Run:
    """A reconstruction into a file, or into several qualities."""

    done: int  # number of frames that existed at the start
    # of the further frames; each step of the generator fits, stores and logs a frame (of one quality)
    reports: Generator[Any, None, None]


def record(
    path: Path,
    source: FrameStream,
    pipeline: Pipeline[State, Memory],
    backend: Backend,
    *,
    resume: bool = False,
    storage: Storage[State] | None = None,
    metadata: Mapping[str, object] | None = None,
    on_step: StepListener | None = None,
    remarks: LogExtras | None = None,
    sound: SoundSource | None = None,
) -> Run:
    """Reconstructs a capture into a file or other storage, with a log next to it.

    The call checks an existing file and starts the log; the file is written as the reports are consumed.

    Args:
        path: the file; an existing one is replaced unless it is resumed.
        source: the capture; frames of a recording are read ahead.
        storage: opens another sink than a file at ``path``, such as :func:`segments_at`.
        metadata: plain JSON values for the header, equal in all runs of a stream.
        sound: what to store beside the frames; None for nothing.

    Raises:
        ConfigError: the file to resume was made with another configuration or from another capture.
        StreamError: the file to resume is not a stream, or is damaged so that it cannot be continued.
        StorageError: the file or the log cannot be written; complete frames in the file are not affected.
    """
    if storage is None:
        sink, resumed = pipeline.codec.file(path, frames=frame_count(source), resume=resume)
    else:
        sink, resumed = storage(resume)
    if sound is not None:
        sink, metadata = with_sound(sink, metadata, sound, source=source, resumed=resumed)
    session = Session(read_ahead(source), sink, pipeline, backend, resumed=resumed, metadata=metadata, on_step=on_step)
    done = 0 if resumed is None else len(resumed)
    begin_log(path, frames=done)
    return Run(done, logged(session.run(), path, remarks))


def logged(
    reports: Generator[FrameReport, None, None], path: Path, remarks: LogExtras | None = None
) -> Generator[FrameReport, None, None]:
    """The reports of a session, each appended to the log next to ``path``, which was begun, before it is yielded.
    Raises StorageError if the log cannot be written."""
    with closing(reports):
        for report in reports:
            further = {} if remarks is None else remarks(report)
            append_log(path, log_entry(report) | dict(further))
            yield report


def segments_at(
    store: Store, *, options: SegmentsOptions | None = None, clocks: Clocks | None = None
) -> Storage[Scene]:
    """Storage for :func:`record`: segments and a preview picture. A stream is replaced unless it is resumed."""

    def opened(resume: bool) -> tuple[PacketSink, StoredSegments | None]:
        if resume:
            sink, found = resume_segments(store, options=options, clocks=clocks)
        else:
            sink, found = SegmentsSink(store, overwrite=True, options=options, clocks=clocks), None
        return PreviewSink(sink, store), found

    return opened


def segments_folder(path: Path, *, may_exist: bool) -> FolderStore:
    """Creates and checks the folder of a segmented stream; called before the fit of frame 0, which takes minutes.
    Raises StorageError if it contains a stream or another program's manifest.json, cannot be created or written, or
    another process writes to it."""
    store = FolderStore(path)
    there = store.names() if path.is_dir() else frozenset()
    if MANIFEST in there and not may_exist:
        raise StorageError(
            f"{path} contains a stream; continue it with --resume, replace it with --overwrite, or choose another name."
        )
    if there == {MANIFEST}:
        try:
            read_manifest(store)
        except StreamError as error:
            raise StorageError(f"{path} has a {MANIFEST} of another program ({error}); choose another name.") from None
    store.make()
    store.lock()
    store.prepare()
    return store


def check_output(path: Path, *, may_exist: bool, resume: bool = True) -> None:
    """Check that the stream can be written; called before the fit of frame 0, which takes minutes.

    Args:
        may_exist: whether an existing file is replaced or continued.
        resume: whether the message names ``--resume``.

    Raises:
        StorageError: the file exists, its folder cannot be created, or there is no permission to write.
    """
    if path.is_dir():
        raise StorageError(
            f"{path} is a folder; give the name of a file, such as {path / 'scene.sgs'}, or add --sink segments."
        )
    if path.exists() and not may_exist:
        ways = "continue it with --resume, replace it" if resume else "replace it"
        raise StorageError(f"{path} exists; {ways} with --overwrite, or choose another name.")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StorageError(f"The folder {path.parent} cannot be created ({error.strerror}).") from None
    if not os.access(path if path.exists() else path.parent, os.W_OK):
        raise StorageError(f"{path} cannot be written (no permission).")


PREVIEW: Final = "preview.png"
PREVIEW_WIDTH: Final = 320


class _ForwardingSink:
    """Forwards a stream to ``sink``, each header as :meth:`_header` returns it: here unchanged."""

    def __init__(self, sink: PacketSink) -> None:
        self._sink = sink

    def open(self, header: StreamHeader) -> int:
        return self._sink.open(self._header(header))

    def begin(self, header: StreamHeader) -> int:
        return self._sink.begin(self._header(header))

    def close(self) -> None:
        self._sink.close()

    def _header(self, header: StreamHeader) -> StreamHeader:
        return header


class PreviewSink(_ForwardingSink):
    """Forwards a stream to ``sink``, and writes ``preview.png`` of each key frame to the same store.

    The picture is rendered on the CPU from the decoded packet, so that the run's GPU memory and random numbers do not
    change. A preview that cannot be written is skipped.
    """

    def __init__(self, sink: PacketSink, store: Store) -> None:
        super().__init__(sink)
        self._store = store
        self._newest: StreamHeader | None = None

    def write(self, packet: Packet) -> int:
        size = self._sink.write(packet)
        if packet.kind is PacketKind.KEY and self._newest is not None:
            with suppress(StorageError):
                self._store.put(PREVIEW, png_bytes(preview(self._newest, packet)))
        return size

    def _header(self, header: StreamHeader) -> StreamHeader:
        self._newest = header
        return header


class SoundSink(_ForwardingSink):
    """Forwards a stream to ``sink``, with the sound of each frame.

    A frame has the packets that begin before it ends, so that a player that has a frame can play on until the next.
    ``after`` is the presentation time of the last frame that is there already; None for a new stream.
    """

    def __init__(self, sink: PacketSink, sound: SoundSource, *, fps: float, after: float | None) -> None:
        super().__init__(sink)
        self._feed = sound.open()
        self._frame_seconds = 1.0 / fps
        self._from = -math.inf
        if after is not None:
            self._from = after + self._frame_seconds
            self._feed.until(self._from)

    def write(self, packet: Packet) -> int:
        # A live camera is heard before its first frame, which may follow the last one that is there.
        until = packet.pts_seconds + self._frame_seconds
        heard = [one for one in self._feed.until(until) if one.seconds >= self._from]
        sound = frame_sound(packet.index, packet.pts_seconds, heard)
        return self._sink.write(replace(packet, sound=sound.pack()))

    def _header(self, header: StreamHeader) -> StreamHeader:
        return replace(header, sound=SoundFormat(self._feed.channels))


def with_sound(
    sink: PacketSink,
    metadata: Mapping[str, object] | None,
    sound: SoundSource,
    *,
    source: FrameStream,
    resumed: StoredStream[State] | None,
) -> tuple[SoundSink, Mapping[str, object]]:
    """The sink of a run with sound, and its metadata, by which a stream is resumed with the same sound alone. Raises
    CaptureError if the sound cannot be read."""
    after = resumed.packets[-1].pts_seconds if resumed is not None and len(resumed) else None
    return SoundSink(sink, sound, fps=source.fps, after=after), {**(metadata or {}), "sound": sound.name}


def copy_with_sound(reader: StreamReader, sink: PacketSink, sound: SoundSource, *, name: str) -> None:
    """Writes the frames of a stream without sound to ``sink``, with sound.

    ``name`` is that of the stream, for messages.

    Raises:
        StreamError: the stream has sound, or a frame is lost.
        CaptureError: the sound cannot be read.
        StorageError: the sink cannot be written.
    """
    if reader.header.sound is not None:
        raise StreamError(f"{name} has sound; take a stream without it.")
    if reader.damage or not len(reader):
        raise StreamError(f"{name} is damaged or empty, so it is not copied; structgstream inspect says where.")

    def stated(header: StreamHeader) -> StreamHeader:
        return replace(header, metadata={**header.metadata, "sound": sound.name})

    heard = SoundSink(sink, sound, fps=reader.header.fps, after=None)
    begins = {period.first_frame for period in reader.periods[1:]}
    heard.open(stated(reader.header))
    with closing(heard):
        for index in range(len(reader)):
            if index in begins:
                heard.begin(stated(reader.header_of(index)))
            heard.write(reader.packets.packet(index))


def preview(header: StreamHeader, packet: Packet) -> NDArray[np.uint8]:
    """A key frame ``[H, W, 3]`` (8-bit sRGB) from the middle training camera, at most 320 pixels wide."""
    name = header.rig.training[len(header.rig.training) // 2]
    camera = header.rig[name]
    width = min(PREVIEW_WIDTH, camera.width)
    view = header.camera(name).resized(width, max(round(camera.height * width / camera.width), 1))
    return render_picture(SceneDecoder(header).decode(packet), view, processor_backend())


BEAT_SECONDS = 2.0
RECENT = 30  # number of frames over which rates are measured
LOGGED = (
    "frames_in_per_second", "frames_out_per_second", "bits_per_second", "stored_after_seconds", "disk_free_bytes",
    "resident_bytes", "live",
)  # fmt: skip
"""Keys of the metrics that a frame's line in the log has, too."""


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
        psnr = getattr(last, "train_psnr", math.nan)
        return {
            "pts_seconds": getattr(last, "pts_seconds", None),
            "bytes": self._bytes,
            "bits_per_second": _bit_rate(self._recent, self._fps),
            "seconds_by_stage": _mean([report.seconds for report in self._recent]),
            "train_psnr": psnr if math.isfinite(psnr) else None,
            "anchors": getattr(last, "anchors", None),
            "free": getattr(last, "free", None),
        }


class RunMetrics:
    """Collects and writes the metrics of a run, of several qualities if they are named; ``captured`` returns the time
    of capture of a frame by its index, Unix time, None if unknown."""

    def __init__(
        self,
        stream: Path,
        *,
        fps: float,
        total: int | None = None,
        live: Callable[[], LiveStatus] | None = None,
        captured: Callable[[int], float | None] | None = None,
        qualities: Sequence[str] = (),
        now: Callable[[], float] = time.monotonic,
        unix: Callable[[], float] = time.time,
    ) -> None:
        self._stream, self._fps, self._total, self._done = stream, fps, total, 0
        self._live, self._captured, self._now, self._unix = live, captured, now, unix
        self._age: float | None = None
        self._begun = now()
        self._state: Literal["waiting", "running", "finished", "failed"] = "waiting"  # for the first frame
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
            self._state = "running"
            self._figures.add(report)
            self._stored.append((self._now(), report.index))
            self._absent = list(report.absent)
            self._done = report.index + 1
            filmed = None if self._captured is None else self._captured(report.index)
            self._age = None if filmed is None else self._unix() - filmed
        self.write()
        if self._live is None:
            return {}
        values = self.values()
        return {"run": {key: values[key] for key in LOGGED}}

    def values(self) -> dict[str, Any]:
        """All metrics, as plain JSON values."""
        live = None if self._live is None else self._live()
        with self._lock:
            now, figures = self._now(), self._figures.values()
            if live is not None:
                self._arrived.append((now, live.sets))
            several = {name: {"frames": own.frames, **own.values()} for name, own in self._qualities.items()}
            if several:  # Numbers of Gaussians and PSNR belong to a single quality.
                figures |= {"train_psnr": None, "anchors": None, "free": None}
            return {
                "format": "structgstream-metrics",
                "version": 1,
                "stream": self._stream.name,
                "state": self._state,
                "process": os.getpid(),
                "updated_unix_seconds": self._unix(),
                "running_seconds": now - self._begun,
                "frames": self._done,
                "frames_total": self._total,
                "fps": self._fps,
                "frames_in_per_second": None if live is None else _rate(self._arrived),
                "frames_out_per_second": _rate(self._stored),
                "stored_after_seconds": self._age,
                **figures,
                "absent": self._absent,
                "disk_free_bytes": free_bytes(self._stream),
                "resident_bytes": resident_bytes(),
                "live": None if live is None else asdict(live),
                **({"qualities": several} if several else {}),
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
        ended: Literal["finished", "failed"] = "failed"
        try:
            yield
            ended = "finished"
        except KeyboardInterrupt:
            ended = "finished"
            raise
        finally:
            stop.set()
            thread.join()
            self._state = ended
            self.write()


def _rate(counted: Sequence[tuple[float, int]]) -> float | None:
    """Increase of a counter per second."""
    if len(counted) < 2 or counted[-1][0] <= counted[0][0]:
        return None
    return (counted[-1][1] - counted[0][1]) / (counted[-1][0] - counted[0][0])


def _bit_rate(reports: Sequence[FrameReport], fps: float) -> float | None:
    """Bits per second of media time, including the time of skipped frames."""
    if not reports:
        return None
    seconds = reports[-1].pts_seconds - reports[0].pts_seconds + 1 / fps
    return 8 * sum(report.bytes for report in reports) / seconds


def _mean(stages: list[Mapping[str, float]]) -> dict[str, float]:
    names = dict.fromkeys(name for own in stages for name in own)
    return {name: sum(own.get(name, 0.0) for own in stages) / len(stages) for name in names}
