# SPDX-License-Identifier: Apache-2.0
"""The frame loop: fit, encode, write; the next frame starts from the decoded one (Note [Closed loop]).

While a frame is fitted, the next one is read and its pictures are preprocessed (``lookahead``). A live source that
returns its newest frame is read only after the previous frame is stored.
"""

from collections import deque
from collections.abc import Generator, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import Generic

import torch

from structgstream.cameras import CameraRig, Similarity, check_rig, normalizing_similarity
from structgstream.codec.container.records import Period
from structgstream.codec.contents import PacketInfo
from structgstream.codec.packets import Packet, PacketKind, PacketSink, StreamHeader, check_picture_sizes
from structgstream.codec.scene_coder import Encoded
from structgstream.data.denoising import denoised
from structgstream.data.points import PointsConfig
from structgstream.data.roving import frame_points, roving_of
from structgstream.data.source import FrameStream, frame_count, is_recording, retain_frames
from structgstream.data.timeline import check_rate
from structgstream.errors import CaptureError, ConfigError, StorageError
from structgstream.frames import MIN_CAMERAS, MultiViewFrame, RovingPicture, check_pictures
from structgstream.kernels.backend import Backend
from structgstream.lookahead import Lookahead
from structgstream.session.frame_report import FrameReport, metered
from structgstream.session.periods import KeyFrames, PeriodPlan
from structgstream.session.pipeline import (
    FrameCoder,
    FrameTask,
    Memory,
    Past,
    Pipeline,
    State,
    StoredStream,
    StreamFacts,
)
from structgstream.session.presets import StreamConfig, completed
from structgstream.session.rate_control import RateController
from structgstream.training.online.preprocess import FramePictures
from structgstream.training.result import StepListener
from structgstream.training.views import training_views


class Session(Generic[State, Memory]):
    """Reconstructs a capture into a sink, frame by frame.

    Args:
        source: the capture, or a live one, which is read until it ends or the loop is stopped.
        sink: receives the packets.
        pipeline: fits and stores frames, such as ``stream_pipeline(PRESETS["compact"])``.
        backend: the compute back-end.
        resumed: a reader of the sink's existing frames, to continue after them; None for a new stream.
        metadata: plain JSON values for the header; must be equal in all runs of a stream.
        on_step: called after every optimisation step; on a GPU and in native iterations after every tenth.

    Raises:
        CalibrationError: the pictures of a camera are larger than a stream allows, or it cannot be drawn as calibrated.
        ConfigError: the source has no rate, or the stream to resume was made with another configuration or from
            another capture.
    """

    def __init__(
        self,
        source: FrameStream,
        sink: PacketSink,
        pipeline: Pipeline[State, Memory],
        backend: Backend,
        *,
        resumed: StoredStream[State] | None = None,
        metadata: Mapping[str, object] | None = None,
        on_step: StepListener | None = None,
    ) -> None:
        check_picture_sizes(source.rig)
        check_rig(source.rig)
        check_rate(source.fps)
        self._source = denoised(source, pipeline.denoising, at=pipeline.denoised)
        self._sink = sink
        self._pipeline = pipeline
        self._backend = backend
        self._resumed = resumed if resumed is not None and len(resumed) else None
        self._on_step = on_step
        self._similarity = normalizing_similarity(source.rig, radius=StreamConfig.NORMALISED_RADIUS)
        self._rig = self._similarity.rig(source.rig)
        self._roving = roving_of(source)
        roving = {} if self._roving is None else {"roving": len(self._roving.pictures)}
        self._facts = StreamFacts(
            codec=pipeline.codec.name,
            rig=source.rig,
            similarity=self._similarity,
            fps=source.fps,
            config=pipeline.config,
            metadata={"capture": source.name, **pipeline.metadata, **roving, **(metadata or {})},
        )
        self._keys = KeyFrames(pipeline.codec.key_interval(source.fps), source.fps)
        self._plan = PeriodPlan(pipeline.period)
        self._controller = RateController(pipeline.rate, source.fps, keys=self._keys)
        self._coder: FrameCoder[State] | None = None
        self._steps: Mapping[str, float] = {}
        self._first = 0  # frame of the period
        self._shown: deque[tuple[int, float | None]] = deque(maxlen=2)  # its last two frames that show something
        if resumed is not None:
            check_resumable(resumed.header, self._facts)

    def run(self) -> Generator[FrameReport, None, None]:
        """Fit, encode and write every frame that the sink does not have yet; yields a report for each.

        A complete stream is not changed. Otherwise the sink is closed, with its index, whenever the loop ends for any
        reason except a failed write.
        """
        resumed, total = self._resumed, frame_count(self._source)
        if resumed is not None and resumed.complete and total is not None and len(resumed) >= total:
            return
        try:
            if resumed is None:
                yield from self._frames(None, 0)
            else:
                self._reopen(resumed)
                if total is None or len(resumed) < total:
                    yield from self._frames(self._restore_past(resumed), len(resumed))
        except BaseException:
            with suppress(StorageError):  # The first error is the one to report.
                self._sink.close()
            raise
        self._sink.close()

    def _frames(self, past: Past[State, Memory] | None, start: int) -> Iterator[FrameReport]:
        method = self._pipeline.method
        with Lookahead(self._observe_frames(start), depth=int(is_recording(self._source))) as observed:
            for meter, task in metered(self._tasks(observed), self._backend.device):
                fit = method.first(task) if past is None else method.next(past, task)
                meter.end("fit", peak="fit")
                encoded = self._encode(fit.scene, task)
                meter.end("encode")
                size = self._write(encoded.packet, task)
                meter.end("write", peak="store")
                past = self._advance(past, encoded.reconstruction, task)
                meter.end("prepare", peak="prepare" if task.frame.index == 0 else None)
                yield meter.report(fit, encoded, size, remarks=task.remarks)

    def _observe_frames(self, start: int) -> Iterator[tuple[MultiViewFrame, FramePictures]]:
        """Each frame from ``start`` on with its preprocessed pictures."""
        method = self._pipeline.method
        # Changes are relative to the previous frame, so a resumed stream reads that one again.
        again = start > 0 and method.needs_before
        frames = self._source.frames(start - again)
        before = None
        if again:
            before = training_views(self._showing_from(next(frames)), self._rig, self._backend.device)
        for index, frame in enumerate(frames, start):
            if frame.index != index:
                raise CaptureError(
                    f"{self._source.name} gives frame {frame.index} where frame {index} belongs; frames count from 0, "
                    "in steps of 1."
                )
            check_pictures(frame, self._rig, capture=self._source.name)
            check_enough_pictures(frame, self._rig, self._source.name)
            pictures = method.observe(frame, before, rig=self._rig, backend=self._backend)
            yield frame, pictures
            if method.needs_before and shows_enough(frame, self._rig):
                before = pictures.views

    def _showing_from(self, frame: MultiViewFrame) -> MultiViewFrame:
        """``frame``, or the last one before it with pictures that are not blank."""
        while frame.index > 0 and not shows_enough(frame, self._rig):
            frame = next(self._source.frames(frame.index - 1))
        return frame

    def _tasks(self, observed: Iterator[tuple[MultiViewFrame, FramePictures]]) -> Iterator[FrameTask]:
        """The tasks of frames; each is created after the previous frame is written, on which its rate scale depends."""
        for frame, pictures in observed:
            key = self._keys.kind(frame.index, frame.pts_seconds) is PacketKind.KEY
            begins = self._plan.due(frame.index, frame.pts_seconds) if key and shows_enough(frame, self._rig) else None
            yield self._task(frame, pictures, begins=begins)

    def _task(self, frame: MultiViewFrame, pictures: FramePictures, *, begins: str | None = None) -> FrameTask:
        pipeline = self._pipeline
        points = partial(
            initial_points_of,
            self._source,
            frame,
            config=pipeline.points,
            seed=pipeline.seed,
            similarity=self._similarity,
        )
        return FrameTask(
            frame,
            pictures,
            self._rig,
            points,
            self._backend,
            seed=frame_seed(pipeline.seed, frame.index),
            steps=self._steps,
            rate_scale=self._controller.rate_scale,
            roving=partial(self._roving_pictures, frame),
            begins=begins,
            on_step=self._on_step,
        )

    def _roving_pictures(self, frame: MultiViewFrame) -> list[RovingPicture]:
        """Those of a roving camera for frame 0, in normalised units."""
        found = () if self._roving is None or frame.index > 0 else self._roving.roving(frame)
        return [replace(picture, camera=self._similarity.camera(picture.camera)) for picture in found]

    def _encode(self, fitted: State, task: FrameTask) -> Encoded[State]:
        """The packet of a frame; writes the header before the first packet of a period."""
        if self._coder is None or task.begins is not None:
            fitted, header = self._pipeline.codec.prepare(fitted, task, self._facts)
            self._coder = self._open(header)
        index, pts_seconds = task.frame.index, task.frame.pts_seconds
        kind = self._keys.kind(index, pts_seconds)
        return self._coder.encode(fitted, index=index, pts_seconds=pts_seconds, kind=kind)

    def _write(self, packet: Packet, task: FrameTask) -> int:
        size = self._sink.write(packet)
        self._note(packet, size, begins=task.begins is not None)
        return size

    def _note(self, packet: Packet | PacketInfo, size: int, *, begins: bool) -> None:
        """Record a written packet for key frames, periods and rate control."""
        index, pts_seconds = packet.index, packet.pts_seconds
        if packet.kind is PacketKind.KEY:
            self._keys.begin(index, pts_seconds)
        self._controller.add(size, packet.kind, index=index, pts_seconds=pts_seconds, begins=begins)

    def _open(self, header: StreamHeader) -> FrameCoder[State]:
        """The coder of the period with this header."""
        self._steps = header.steps
        coder = self._pipeline.codec.coder(header, self._backend.device)
        if self._coder is None:
            self._sink.open(header)
        else:
            self._sink.begin(header)
        return coder

    def _advance(self, past: Past[State, Memory] | None, state: State, task: FrameTask) -> Past[State, Memory]:
        """The state from which the next frame is fitted."""
        method = self._pipeline.method
        index, shows = task.frame.index, shows_enough(task.frame, self._rig)
        if past is not None and task.begins is None:
            self._measure(state, task)
            if shows:
                self._shown.append((index, task.frame.pts_seconds))
            self._keep(index)
            # Where too few cameras show something, the scene before is repeated.
            earlier = past.state if shows else past.before_previous
            return Past(state, past.memory, earlier if method.needs_before_previous else None, self._seconds_shown)
        self._begin(index, [(index, task.frame.pts_seconds)])
        self._plan.begin(index, task.frame.pts_seconds)
        self._keep(index)
        self._measure(state, task)
        return Past(state, method.prepare(state, lambda: task))

    def _begin(self, first: int, shown: Iterable[tuple[int, float | None]]) -> None:
        """A period has begun with frame ``first``; ``shown`` are its last frames that show something."""
        self._first = first
        self._shown.clear()
        self._shown.extend(shown)

    def _keep(self, index: int) -> None:
        """Ask the source to keep the pictures that a run resumed after frame ``index`` would read again."""
        retain_frames(self._source, self._first, last=max(self._plan.remembered, index + 1 - self._shown[0][0]))

    @property
    def _seconds_shown(self) -> tuple[float, float] | None:
        """Presentation times of the last two frames that show something; None unless both are known."""
        match [seconds for _, seconds in self._shown if seconds is not None]:
            case [before, last]:
                return before, last
        return None

    def _measure(self, state: State, task: FrameTask) -> None:
        """Add the residual of a decoded frame to the plan of periods, if the plan needs it."""
        index = task.frame.index
        if self._pipeline.residual is None or not shows_enough(task.frame, self._rig):
            return
        if self._plan.measures(index, task.frame.pts_seconds, self._keys):
            self._plan.add(index, self._pipeline.residual(state, task))

    def _reopen(self, resumed: StoredStream[State]) -> None:
        """Continue an existing stream."""
        self._coder = self._open(resumed.header_of(len(resumed) - 1))
        for info in resumed.packets:
            begins = info.index > 0 and resumed.period(info.index).first_frame == info.index
            self._note(info, info.bytes, begins=begins)

    def _restore_past(self, resumed: StoredStream[State]) -> Past[State, Memory]:
        """The state from which the next frame is fitted, decoded from the existing stream."""
        assert self._coder is not None, "reopened before"
        method, count = self._pipeline.method, len(resumed)
        state = deque(map(self._coder.replay, resumed.group(count - 1)), maxlen=1).pop()
        period = resumed.period(count - 1)
        first = period.first_frame
        needs_earlier = method.needs_before_previous
        shown = self._last_shown(count, first) if needs_earlier else [*range(max(count - 2, first), count)]
        seconds = {info.index: info.pts_seconds for info in resumed.packets}
        # A group of frames has packets of its own frames only: when those before were shown is not known.
        self._begin(first, ((index, seconds.get(index)) for index in shown))
        earlier = resumed.scene(shown[0]) if needs_earlier and len(shown) == 2 else None
        self._keep(count - 1)
        if self._pipeline.period.enabled:
            self._restore_plan(resumed, period)
        memory = method.prepare(resumed.scene(first), partial(self._task_again, first))
        return Past(state, memory, earlier, self._seconds_shown)

    def _last_shown(self, count: int, first: int) -> list[int]:
        """The last two frames, of those from ``first`` to ``count``, whose pictures show something; the first does."""
        found: list[int] = []
        for index in range(count - 1, first, -1):
            if shows_enough(next(self._source.frames(index)), self._rig):
                found.append(index)
            if len(found) == 2:
                break
        return [first, *reversed(found)][-2:]

    def _restore_plan(self, resumed: StoredStream[State], period: Period) -> None:
        """Restore the plan of periods: the start of the last period, and residuals, which are measured again."""
        seconds = [info.pts_seconds for info in resumed.packets]
        self._plan.begin(period.first_frame, seconds[period.first_frame], number=period.number)
        for index in self._plan.needed(seconds, self._keys):
            self._measure(resumed.scene(index), self._task_again(index))

    def _task_again(self, index: int) -> FrameTask:
        """The task of an existing frame; reads its pictures again."""
        frame = next(self._source.frames(index))
        check_enough_pictures(frame, self._rig, self._source.name)
        return self._task(frame, self._pipeline.method.observe(frame, None, rig=self._rig, backend=self._backend))


def frame_seed(seed: int, index: int) -> int:
    """The seed of a frame, which depends only on its index, so that a frame can be repeated separately."""
    return (seed * 1_000_003 + index) % 2**63


def shows_enough(frame: MultiViewFrame, rig: CameraRig) -> bool:
    """Whether a later frame can be fitted: at least two training cameras have pictures that are not blank."""
    return len(frame.showing(rig.training)) >= MIN_CAMERAS


def check_enough_pictures(frame: MultiViewFrame, rig: CameraRig, capture: str) -> None:
    """Check that at least two training cameras have pictures, which in frame 0 must not be blank. Raises CaptureError
    if they do not; the message names the cameras."""
    present = frame.present(rig.training) if frame.index else frame.showing(rig.training)
    if len(present) < MIN_CAMERAS:
        raise CaptureError(
            f"Frame {frame.index} of {capture} has pictures of {', '.join(present) or 'none'} of its "
            f"{len(rig.training)} training cameras; at least {MIN_CAMERAS} are needed. Restore them, or choose "
            "frames before or after it (--start, --frames)."
        )


def initial_points_of(
    source: FrameStream, frame: MultiViewFrame, *, config: PointsConfig, seed: int, similarity: Similarity
) -> torch.Tensor:
    """Normalised points ``[P, 3]`` of the capture, or estimated from ``frame``, after checking the poses.

    A capture's points are those of its first frame; at the beginning of later periods they are estimated.
    """
    from structgstream.pose_check.check import check_poses

    check_poses(frame, source.rig)
    given = source.points if frame.index == 0 else None
    if given is None:
        given = frame_points(source, frame, config=config, seed=seed)
    if given.ndim != 2 or given.shape[1] != 3:
        raise CaptureError(f"The points of {source.name} have shape {given.shape}; expected [P, 3], positions alone.")
    return similarity.points(torch.from_numpy(given))


def check_resumable(header: StreamHeader, facts: StreamFacts) -> None:
    """Check that a stream was made with the same method, configuration and capture. Raises ConfigError if it was not;
    the message names the differences."""
    if header.codec != facts.codec:
        raise ConfigError(
            f"The stream was made by another method or codec, {header.codec!r} instead of {facts.codec!r}. "
            "Resume with the same, or start again with --overwrite."
        )
    differing = list(_differences(dict(completed(header.config)), dict(completed(facts.config))))
    if differing:
        raise ConfigError(
            f"The stream was made with another configuration: {', '.join(differing[:5])} differ. "
            "Resume with the same preset and options, or start again with --overwrite."
        )
    theirs = _capture_facts(header.rig, header.fps, header.metadata)
    differing = list(_differences(theirs, _capture_facts(facts.rig, facts.fps, facts.metadata)))
    if differing:
        plain = [f"{name} {theirs[name]!r}" for name in differing if isinstance(theirs.get(name), str | int | float)]
        stated = f" (in the stream: {', '.join(plain)})" if plain else ""
        raise ConfigError(
            f"The stream was made from another capture or another part of it: {', '.join(differing[:5])} differ. "
            f"Resume with the same capture and options{stated}, or start again with --overwrite."
        )


def _capture_facts(rig: CameraRig, fps: float, metadata: Mapping[str, object]) -> dict[str, object]:
    """The properties of a capture that must be equal to continue a stream, as plain values."""
    return {"order of cameras": [*rig], "cameras": rig.plain(), "fps": fps, **metadata}


def _differences(old: object, new: object, path: str = "") -> Iterator[str]:
    """Paths at which two trees of plain JSON values differ."""
    if isinstance(old, dict) and isinstance(new, dict):
        for key in sorted({*old, *new}):
            yield from _differences(old.get(key), new.get(key), f"{path}.{key}" if path else key)
    elif old != new:
        yield path
