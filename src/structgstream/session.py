# SPDX-License-Identifier: Apache-2.0
"""The loop: frames in, packets out, and the decoded scene is where the next frame starts (Note [Closed loop])."""

import time
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field

import numpy as np
import torch

from structgstream.cameras import CameraRig
from structgstream.codec.bins import FREE_STEPS
from structgstream.codec.encoder import SceneEncoder
from structgstream.codec.packets import PacketKind, PacketSink, StreamHeader
from structgstream.codec.reader import StreamReader
from structgstream.codec.static_fields import on_bins
from structgstream.data.points import PointsConfig, initial_points
from structgstream.data.source import FrameSource
from structgstream.errors import ConfigError, StorageError
from structgstream.frames import MultiViewFrame
from structgstream.kernels.backend import Backend
from structgstream.memory import PeakKind, PeakMeter
from structgstream.presets import StreamConfig, to_json
from structgstream.rate_control import RateController, pressed
from structgstream.scene.appearance import with_appearance
from structgstream.scene.order import in_space_order
from structgstream.scene.scene import Scene
from structgstream.scene.state import FieldName, on_device, scene_of, state_of
from structgstream.similarity import Similarity, normalising_similarity
from structgstream.training.first_bins import Sensitivity, first_bins, regauged, sensitivity_of
from structgstream.training.initial import fit_first_frame
from structgstream.training.online import fit_next_frame
from structgstream.training.result import FitResult, StepListener
from structgstream.training.rounding import pixel_size


@dataclass(frozen=True)
class FrameReport:
    """What happened to one frame.

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
    seconds: Mapping[str, float] = field(default_factory=dict)
    peak_memory_bytes: Mapping[str, int] = field(default_factory=dict)
    peak_device_bytes: Mapping[str, int] = field(default_factory=dict)
    peak_memory_kind: PeakKind = PeakKind.NONE
    cpu_seconds: float = 0.0


def frame_seed(seed: int, index: int) -> int:
    """A seed of its own for each frame, so that a frame can be repeated alone."""
    return (seed * 1_000_003 + index) % 2**63


def initial_points_of(
    source: FrameSource, frame: MultiViewFrame, *, config: PointsConfig, seed: int, similarity: Similarity
) -> torch.Tensor:
    """Points ``[P, 3]`` of the capture or made from ``frame``, normalised, after a look at the poses."""
    from structgstream.data.pose_check import check_poses

    check_poses(frame, source.rig)
    given = source.points
    if given is None:
        given = initial_points(frame, source.rig, config=config, seed=seed).positions
    return similarity.points(torch.from_numpy(given))


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
            self._check_resumable(resumed.header)

    def run(self) -> Iterator[FrameReport]:
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
        scene: Scene | None = None
        steps: Mapping[str, float] = {}
        controller = RateController(self._config.rate, self._source.fps)
        start = 0
        if self._resumed is not None:
            encoder, steps = SceneEncoder(self._resumed.header), self._resumed.header.steps
            self._sink.open(self._resumed.header)
            start = len(self._resumed)
            for info in self._resumed.packets:
                controller.add(info.bytes, info.kind)
            for packet in self._resumed.group(start - 1) if start else ():
                scene = encoder.follow(packet)
        if start >= len(self._source):
            return
        # What moves shows against the frame before, so a resumed stream reads that one once more.
        again = start > 0 and self._config.online.motion.enabled
        frames = self._source.frames(start - again)
        before = next(frames) if again else None
        while True:
            peaks = PeakMeter(self._backend.device)
            started, cpu_started = time.perf_counter(), time.process_time()
            frame = next(frames, None)
            if frame is None:
                return
            peaks.end("read")
            read = time.perf_counter()
            fit = self._fit(scene, frame, before, steps, controller.pressure)
            before = frame if self._config.online.motion.enabled else None
            peaks.end("fit")
            fitted = time.perf_counter()
            fitted_scene = fit.scene
            if scene is None:
                fitted_scene, header = self._prepared(fitted_scene)
                if encoder is None:
                    encoder, steps = SceneEncoder(header), header.steps
                    self._sink.open(header)
            assert encoder is not None, "there is one with a scene"
            kind = PacketKind.KEY if frame.index % self._key_interval == 0 else PacketKind.DELTA
            encoded = encoder.encode(fitted_scene, index=frame.index, pts_seconds=frame.pts_seconds, kind=kind)
            scene = encoded.reconstruction
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

    @property
    def _key_interval(self) -> int:
        return max(1, round(self._source.fps * self._config.key_interval_seconds))

    def _fit(
        self,
        scene: Scene | None,
        frame: MultiViewFrame,
        before: MultiViewFrame | None,
        steps: Mapping[str, float],
        pressure: float,
    ) -> FitResult:
        seed = frame_seed(self._config.seed, frame.index)
        if scene is None:
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
        return fit_next_frame(
            on_device(scene, self._backend.device),
            frame,
            self._rig,
            config=pressed(self._config.online, pressure),
            backend=self._backend,
            seed=seed,
            before=before,
            steps=steps,
            on_step=self._on_step,
        )

    def _prepared(self, scene: Scene) -> tuple[Scene, StreamHeader]:
        """Frame 0 as the frames after it need it, and the header that they need."""
        dynamic, rounding = self._config.online.dynamic, self._config.online.rounding
        worth: Sensitivity | None = None
        if self._config.codec == "compact":
            worth = sensitivity_of(scene, self._rig, backend=self._backend, seed=frame_seed(self._config.seed, 0))
            scene, worth = regauged(scene, worth)
        if "appearance" in dynamic:
            scene = with_appearance(scene, self._config.online.appearance_rank)
        if worth is None:
            return scene, self._header(scene)
        known = rounding.steps(pixel_size(scene.anchors.positions, self._rig))
        used = {*dynamic, *(FREE_STEPS if "free" in dynamic else ())}
        steps = {name: float(np.float32(step)) for name, step in known.items() if name in used}
        voxel_size = self._config.initial.voxel_size
        scene, init_steps = first_bins(scene, worth, config=rounding, voxel_size=voxel_size, steps=steps)
        state = on_bins(state_of(in_space_order(scene, step=init_steps["anchor_positions"])), init_steps)
        scene = scene_of(state, distance_input=scene.distance_input)
        return scene, self._header(scene, steps=steps, init_steps=init_steps)

    def _header(
        self,
        scene: Scene,
        *,
        steps: Mapping[str, float] | None = None,
        init_steps: Mapping[FieldName, float] | None = None,
    ) -> StreamHeader:
        dynamic, state = self._config.online.dynamic, state_of(scene)
        reference = dynamic.difference(["free", "free_births"]) if steps else ()
        return StreamHeader(
            rig=self._source.rig,
            similarity=self._similarity,
            fps=self._source.fps,
            codec=self._config.codec,
            dynamic=dynamic,
            static={name: value.cpu() for name, value in state.items() if name not in dynamic},
            distance_input=scene.distance_input,
            config=to_json(self._config),
            metadata=self._metadata,
            steps=steps or {},
            reference={name: state[name].cpu() for name in reference},
            init_steps=init_steps or {},
        )

    def _check_resumable(self, header: StreamHeader) -> None:
        """Refuse to continue a stream with another configuration or capture: its frames would not fit together."""
        differing = list(_differences(dict(header.config), to_json(self._config)))
        if differing:
            raise ConfigError(
                f"The stream was made with another configuration: {', '.join(differing[:5])} differ. "
                "Resume with the same preset and options, or start again with --overwrite."
            )
        differing = list(_differences(_capture_facts(header.rig, header.fps, header.metadata), self._facts()))
        if differing:
            raise ConfigError(
                f"The stream was made from another capture or another part of it: {', '.join(differing[:5])} differ. "
                "Resume with the same capture and options, or start again with --overwrite."
            )

    def _facts(self) -> dict[str, object]:
        return _capture_facts(self._source.rig, self._source.fps, self._metadata)


def _capture_facts(rig: CameraRig, fps: float, metadata: Mapping[str, object]) -> dict[str, object]:
    """What two captures must have in common for their frames to fit into one stream, as plain values."""
    cameras = {
        name: {
            "viewmat": rig[name].viewmat.tolist(),
            "K": rig[name].K.tolist(),
            "size": [rig[name].width, rig[name].height],
            "near": rig[name].near,
            "held out": name in rig.held_out,
        }
        for name in rig
    }
    return {"order of cameras": [*rig], "cameras": cameras, "fps": fps, **metadata}


def _differences(old: object, new: object, path: str = "") -> Iterator[str]:
    """Paths at which two trees of plain JSON values differ."""
    if isinstance(old, dict) and isinstance(new, dict):
        for key in sorted({*old, *new}):
            yield from _differences(old.get(key), new.get(key), f"{path}.{key}" if path else key)
    elif old != new:
        yield path
