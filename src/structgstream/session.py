# SPDX-License-Identifier: Apache-2.0
"""The loop: frames in, packets out, and the decoded scene is where the next frame starts (Note [Closed loop]).

While a frame is fitted, the next one is read and what moves in its pictures is looked for (``lookahead``)."""

import time
from collections.abc import Generator, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field

from structgstream.beginning import begun, frame_seed, initial_points_of
from structgstream.codec.encoder import SceneEncoder
from structgstream.codec.packets import PacketKind, PacketSink
from structgstream.codec.reader import StreamReader
from structgstream.data.source import FrameSource
from structgstream.errors import ConfigError, StorageError
from structgstream.frames import MultiViewFrame
from structgstream.kernels.backend import Backend
from structgstream.lookahead import Lookahead
from structgstream.memory import PeakKind, PeakMeter
from structgstream.presets import StreamConfig
from structgstream.rate_control import RateController, pressed
from structgstream.resuming import check_resumable
from structgstream.scene.scene import Scene
from structgstream.scene.state import FieldName, on_device
from structgstream.similarity import normalising_similarity
from structgstream.training.initial import fit_first_frame
from structgstream.training.online import fit_next_frame, remembers
from structgstream.training.pictures import FramePictures, pictures_of
from structgstream.training.residuals import ResidualFloor, residual_floor
from structgstream.training.result import FitResult, StepListener
from structgstream.training.views import training_views


@dataclass(frozen=True)
class FrameReport:
    """What happened to one frame.

    ``spawned`` and ``pruned`` count free Gaussians, ``grown`` and ``removed`` anchors.

    Peaks of memory are by stage: ``read``, ``fit``, and ``store`` for encoding and writing. ``peak_memory_kind`` says
    whether they are each stage's own (Note [Peaks]); ``peak_device_bytes`` has the GPU's, when there is one.
    ``cpu_seconds`` is the time of all the process's threads together, which other processes do not lengthen.
    """

    index: int
    pts_seconds: float
    kind: PacketKind
    bytes: int
    field_bytes: Mapping[FieldName, int]
    train_psnr: float
    anchors: int
    moving: int
    free: int
    spawned: int
    pruned: int
    grown: int = 0
    removed: int = 0
    seconds: Mapping[str, float] = field(default_factory=dict)
    peak_memory_bytes: Mapping[str, int] = field(default_factory=dict)
    peak_device_bytes: Mapping[str, int] = field(default_factory=dict)
    peak_memory_kind: PeakKind = PeakKind.NONE
    cpu_seconds: float = 0.0
    counts: Mapping[str, int] = field(default_factory=dict)


@dataclass
class _Past:
    """What a frame is fitted after: the last scene, the one before it, what frame 0 missed, as far as they count."""

    scene: Scene | None = None
    older: Scene | None = None
    floor: ResidualFloor | None = None


class Session:
    """Reconstructs a capture into a sink, frame by frame.

    Args:
        source: the capture.
        sink: where packets go.
        config: everything that decides the result.
        backend: what computes.
        resumed: the reader of what the sink already holds, to continue after it.
        metadata: plain JSON values for the header (nothing that differs between runs: resuming is exact).
        first: frame 0 as it was fitted before, with the same capture, seed and ``config.initial``; variants that differ
            in later frames alone can share it.
        on_step: called after every optimisation step.

    Raises:
        ConfigError: the stream to resume was made with another configuration or from another capture.
    """

    def __init__(
        self,
        source: FrameSource,
        sink: PacketSink,
        config: StreamConfig,
        backend: Backend,
        *,
        resumed: StreamReader | None = None,
        metadata: Mapping[str, object] | None = None,
        first: FitResult | None = None,
        on_step: StepListener | None = None,
    ) -> None:
        self._source = source
        self._sink = sink
        self._config = config
        self._backend = backend
        self._resumed = resumed
        self._metadata = {"capture": source.name, **(metadata or {})}
        self._first = first
        self._on_step = on_step
        self._similarity = normalising_similarity(source.rig, radius=config.normalised_radius)
        self._rig = self._similarity.rig(source.rig)
        if config.rate.target_mbits is not None and config.codec != "compact":
            raise ConfigError(
                f"A target of {config.rate.target_mbits:g} Mbit/s was given for a stream with codec {config.codec!r}, "
                "whose packets are as large as they are; take --preset compact, or leave the target out."
            )
        if resumed is not None:
            check_resumable(resumed.header, source, config=config, metadata=self._metadata)

    def run(self) -> Generator[FrameReport, None, None]:
        """Fit, encode and write every frame that the sink does not hold yet; yields a report for each.

        The sink is closed, with its index, however the loop ends; only a sink that could not write gets no index.
        """
        try:
            yield from self._frames()
        except BaseException:
            with suppress(StorageError):  # What went wrong first is what the user must see.
                self._sink.close()
            raise
        self._sink.close()

    def _frames(self) -> Iterator[FrameReport]:
        encoder: SceneEncoder | None = None
        past, online = _Past(), self._config.online
        steps: Mapping[str, float] = {}
        controller = RateController(self._config.rate, self._source.fps, key_interval=self._key_interval)
        start = 0
        if self._resumed is not None:
            encoder, steps = SceneEncoder(self._resumed.header), self._resumed.header.steps
            self._sink.open(self._resumed.header)
            start = len(self._resumed)
            for info in self._resumed.packets:
                controller.add(info.bytes, info.kind)
            for packet in self._resumed.group(start - 1) if start else ():
                past.scene = encoder.follow(packet)
            if remembers(online) and start > 1:
                past.older = self._resumed.scene(start - 2)
        if start >= len(self._source):
            return
        if start > 0 and online.motion.residual_threshold > 0.0:
            assert self._resumed is not None
            past.floor = self._floor(self._resumed.scene(0), next(self._source.frames(0)))
        # What moves shows against the frame before, so a resumed stream reads that one once more.
        again = start > 0 and online.motion.enabled
        frames = self._source.frames(start - again)
        last = next(frames) if again else None
        with Lookahead(self._shown(frames, last)) as shown:
            yield from self._fitted(shown, past, encoder, steps, controller)

    def _fitted(
        self,
        shown: Iterator[tuple[MultiViewFrame, FramePictures | None]],
        past: _Past,
        encoder: SceneEncoder | None,
        steps: Mapping[str, float],
        controller: RateController,
    ) -> Iterator[FrameReport]:
        """Fit, encode and write every frame that is ``shown``, beginning after ``past``."""
        online = self._config.online
        while True:
            peaks = PeakMeter(self._backend.device)
            started, cpu_started = time.perf_counter(), time.process_time()
            found = next(shown, None)
            if found is None:
                return
            frame, pictures = found
            peaks.end("read")
            read = time.perf_counter()
            fit = self._fit(past, frame, pictures, steps, controller.pressure)
            peaks.end("fit")
            fitted = time.perf_counter()
            fitted_scene = fit.scene
            if past.scene is None:
                fitted_scene, header = begun(
                    fitted_scene,
                    self._source,
                    frame=frame,
                    config=self._config,
                    metadata=self._metadata,
                    similarity=self._similarity,
                    backend=self._backend,
                )
                if encoder is None:
                    encoder, steps = SceneEncoder(header), header.steps
                    self._sink.open(header)
            assert encoder is not None, "there is one with a scene"
            kind = PacketKind.KEY if frame.index % self._key_interval == 0 else PacketKind.DELTA
            encoded = encoder.encode(fitted_scene, index=frame.index, pts_seconds=frame.pts_seconds, kind=kind)
            scene = encoded.reconstruction
            if frame.index == 0 and online.motion.residual_threshold > 0.0:
                past.floor = self._floor(scene, frame)
            past = _Past(
                scene,
                floor=past.floor,
                older=past.scene if remembers(online) else None,
            )
            coded = time.perf_counter()
            size = self._sink.write(encoded.packet)
            controller.add(size, kind)
            peaks.end("store")
            done = time.perf_counter()
            yield FrameReport(
                index=frame.index,
                pts_seconds=frame.pts_seconds,
                kind=kind,
                bytes=size,
                field_bytes=encoded.packet.field_bytes,
                train_psnr=fit.train_psnr,
                anchors=len(scene.anchors),
                moving=fit.moving,
                free=len(scene.free),
                spawned=fit.spawned,
                pruned=fit.pruned,
                counts=dict(fit.counts),
                grown=fit.grown,
                removed=fit.removed,
                seconds={
                    "read": read - started,
                    **fit.seconds,
                    "fit": fitted - read,
                    "encode": coded - fitted,
                    "write": done - coded,
                    "total": done - started,
                },
                peak_memory_bytes=peaks.process_bytes,
                peak_device_bytes=peaks.device_bytes,
                peak_memory_kind=peaks.kind,
                cpu_seconds=time.process_time() - cpu_started,
            )

    def _shown(
        self, frames: Iterator[MultiViewFrame], last: MultiViewFrame | None
    ) -> Iterator[tuple[MultiViewFrame, FramePictures | None]]:
        """Each frame, and what its pictures tell by themselves; nothing of the frame that a stream begins with."""
        online = self._config.online
        for frame in frames:
            pictures = None
            if frame.index > 0:
                pictures = pictures_of(
                    frame, self._rig, before=last, motion=online.motion, start=online.start, backend=self._backend
                )
            last = frame
            yield frame, pictures

    def _floor(self, scene: Scene, frame: MultiViewFrame) -> ResidualFloor:
        device, scale = self._backend.device, self._config.online.motion.picture_scale
        views = training_views(frame, self._rig, device)
        return residual_floor(on_device(scene, device), views, scale=scale, backend=self._backend)

    @property
    def _key_interval(self) -> int:
        return max(1, round(self._source.fps * self._config.key_interval_seconds))

    def _fit(
        self,
        past: _Past,
        frame: MultiViewFrame,
        pictures: FramePictures | None,
        steps: Mapping[str, float],
        pressure: float,
    ) -> FitResult:
        seed = frame_seed(self._config.seed, frame.index)
        if past.scene is None:
            if self._first is not None:
                return self._first
            points = initial_points_of(
                self._source,
                frame,
                config=self._config.points,
                seed=self._config.seed,
                similarity=self._similarity,
            )
            return fit_first_frame(
                frame,
                self._rig,
                points,
                config=self._config.initial,
                backend=self._backend,
                seed=seed,
                on_step=self._on_step,
            )
        device = self._backend.device
        return fit_next_frame(
            on_device(past.scene, device),
            frame,
            self._rig,
            config=pressed(self._config.online, pressure),
            backend=self._backend,
            seed=seed,
            pictures=pictures,
            steps=steps,
            floor=past.floor,
            older=None if past.older is None else on_device(past.older, device),
            on_step=self._on_step,
        )
