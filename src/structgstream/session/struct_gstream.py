# SPDX-License-Identifier: Apache-2.0
"""Struct-GStream: frame 0 from initial points, each later frame from the decoded previous one; and its two codecs of
scenes, ``raw`` and ``compact``, with their headers."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from structgstream.cameras import NEAR_IN_RIG_RADII, CameraRig
from structgstream.codec.fields.quantization import float32, round_to_bins
from structgstream.codec.packets import StreamHeader
from structgstream.codec.reader import StreamReader
from structgstream.codec.scene_coder import SceneEncoder
from structgstream.codec.sinks import FileSink
from structgstream.errors import CalibrationError, ConfigError
from structgstream.frames import MultiViewFrame
from structgstream.kernels.backend import Backend
from structgstream.scene.appearance import with_appearance
from structgstream.scene.order import in_morton_order
from structgstream.scene.sampling import RigSampling
from structgstream.scene.scene import Scene
from structgstream.scene.state import (
    FieldName,
    fields_of,
    on_device,
    parameters_of,
    state_of,
    with_dynamic_fields,
    with_state,
)
from structgstream.session.pipeline import FrameTask, Past, Pipeline, StreamFacts
from structgstream.session.presets import StreamConfig, to_json
from structgstream.session.rate_control import with_rate_control
from structgstream.training.frame0.fit import fit_first_frame, fit_first_frame_again
from structgstream.training.frame0.quantization import (
    Sensitivity,
    estimate_sensitivity,
    quantize_first_frame,
    whiten_features,
)
from structgstream.training.frame0.seeding import fit_environment
from structgstream.training.online.exposure import ExposureReference, exposure_reference
from structgstream.training.online.fit import fit_next_frame, needs_before_previous
from structgstream.training.online.preprocess import FramePictures, preprocess
from structgstream.training.parameters import pixel_size
from structgstream.training.residuals import BaselineResidual, baseline_residual, mean_residual
from structgstream.training.result import FitResult
from structgstream.training.views import View


@dataclass(frozen=True)
class SceneCodec:
    """Stores scenes: with codec ``raw`` every number as float32; with ``compact`` all values are quantized
    (``codec/fields/quantization.py``, Note [Bins]), and anchors are in Z-order."""

    config: StreamConfig

    @property
    def name(self) -> str:
        return self.config.codec

    def key_interval(self, fps: float) -> int:
        return self.config.key_interval(fps)

    def file(self, path: Path, *, frames: int | None, resume: bool) -> tuple[FileSink, StreamReader | None]:
        """A sink to the file, which is replaced unless it is resumed; ``frames`` is not used.

        Raises:
            StorageError: another process writes to the file.
            StreamError: the file to resume is not a stream, or is damaged so that it cannot be continued.
        """
        sink = FileSink(path, overwrite=True)
        sink.check_unused()
        return FileSink.resume(path) if resume else (sink, None)

    def coder(self, header: StreamHeader, device: torch.device) -> SceneEncoder:
        """The encoder of the stream; it decodes on the CPU."""
        return SceneEncoder(header)

    def prepare(self, fitted: Scene, task: FrameTask, facts: StreamFacts) -> tuple[Scene, StreamHeader]:
        """The reconstruction of a period's first frame, which later frames and receivers use, and its header."""
        steps: Mapping[str, float] = {}  # of packets, by parameter
        init_steps: Mapping[FieldName, float] = {}  # of the init record
        if self.config.codec == "raw":
            scene = self._with_dynamic_fields(fitted)
        else:
            measured = estimate_sensitivity(fitted, task.rig, backend=task.backend, seed=task.seed)
            scene, sensitivity = whiten_features(fitted, measured)
            scene = self._with_dynamic_fields(scene)
            steps = self._packet_steps(scene, task.rig)
            scene, init_steps = self._quantized(scene, sensitivity, steps)
        state, dynamic = state_of(scene), self.config.online.dynamic
        reference = dynamic.difference(fields_of("free")) if steps else ()
        header = StreamHeader(
            rig=facts.rig,
            similarity=facts.similarity,
            fps=facts.fps,
            codec=facts.codec,
            dynamic=dynamic,
            static={name: value.cpu() for name, value in state.items() if name not in dynamic},
            distance_input=scene.distance_input,
            config=facts.config,
            metadata=facts.metadata,
            steps=steps,
            reference={name: state[name].cpu() for name in reference},
            init_steps=init_steps,
            periods=self.config.period.enabled,
        )
        return scene, header

    def _packet_steps(self, scene: Scene, rig: CameraRig) -> dict[str, float]:
        """The quantization steps of packets, by parameter."""
        pixel = pixel_size(scene.anchors.positions, [rig[name] for name in rig.training])
        if pixel is None:
            near = max(rig[name].near for name in rig.training) / StreamConfig.NORMALISED_RADIUS
            raise CalibrationError(
                "No training camera sees an anchor of frame 0, so positions have no step. The near plane lies at "
                f"{near:.3g} times the rig's radius, by default at {NEAR_IN_RIG_RADII:g}: choose another --near, or "
                "check the calibration with structgstream prepare --check."
            )
        used = {parameter.name for parameter in parameters_of(self.config.online.dynamic)}
        known = self.config.online.rounding.steps(pixel)
        return {name: float32(step) for name, step in known.items() if name in used}

    def _quantized(
        self, scene: Scene, sensitivity: Sensitivity, steps: Mapping[str, float]
    ) -> tuple[Scene, Mapping[FieldName, float]]:
        """Frame 0 as a receiver decodes it, and the quantization steps of the init record."""
        rounding, voxel_size = self.config.online.rounding, self.config.initial.voxel_size
        scene, init_steps = quantize_first_frame(
            scene, sensitivity, config=rounding, voxel_size=voxel_size, steps=steps
        )
        if scene.environment is not None:
            init_steps["environment"] = float32(self.config.environment.STEP)
        rounded = round_to_bins(state_of(in_morton_order(scene, step=init_steps["anchor_positions"])), init_steps)
        return with_state(scene, rounded), init_steps

    def _with_dynamic_fields(self, scene: Scene) -> Scene:
        """``scene`` with all dynamic fields; dynamic appearance gets its basis."""
        online = self.config.online
        if "appearance" in online.dynamic:
            scene = with_appearance(scene, online.appearance_rank)
        return with_dynamic_fields(scene, online.dynamic)


@dataclass(frozen=True)
class FrameZeroContext:
    """The data of a period's first frame that later frames need in addition to its scene; None if not used."""

    baseline: BaselineResidual | None = None
    light: ExposureReference | None = None  # exposure reference: its pictures and F_c


@dataclass(frozen=True)
class StructGStream:
    """The method. Its memory is :class:`FrameZeroContext`."""

    config: StreamConfig  # configuration of the stream
    # returns an earlier fit of frame 0 with the same capture, seed and config.initial, for configurations that differ
    # only in later frames. None: frame 0 is fitted.
    fitted: Callable[[], FitResult[Scene]] | None = None

    @property
    def needs_before(self) -> bool:
        """Whether changed pixels are detected, which needs the previous pictures."""
        return self.config.online.motion.enabled

    @property
    def needs_before_previous(self) -> bool:
        return needs_before_previous(self.config.online)

    def observe(
        self, frame: MultiViewFrame, before: Sequence[View] | None, *, rig: CameraRig, backend: Backend
    ) -> FramePictures:
        """The training pictures and their changes."""
        online = self.config.online
        return preprocess(
            frame, rig, before=before, motion=online.motion, scene_flow=online.scene_flow, backend=backend
        )

    def first(self, task: FrameTask) -> FitResult[Scene]:
        """Fit frame 0, with its environment if enabled."""
        config = self.config
        if self.fitted is not None and task.begins is None:
            fit = self.fitted()
        else:
            fit = fit_first_frame(
                task.frame,
                task.rig,
                task.points(),
                config=config.initial,
                backend=task.backend,
                seed=task.seed,
                on_step=task.on_step,
                roving=task.roving(),
            )
        return self._with_environment(fit, task)

    def _with_environment(self, fit: FitResult[Scene], task: FrameTask) -> FitResult[Scene]:
        config = self.config.environment
        if not config.enabled:
            return fit
        found = fit_environment(fit.scene, task.pictures.views, config=config, backend=task.backend)
        return replace(fit, scene=replace(fit.scene, environment=found))

    def prepare(self, state: Scene, task: Callable[[], FrameTask]) -> FrameZeroContext:
        """The baseline residuals of frame 0, if residuals are used, and its exposure reference, if it is needed."""
        motion, light = self.config.online.motion, self.config.online.exposure
        if motion.residual_threshold <= 0.0 and not light.enabled:
            return FrameZeroContext()
        first = task()
        scene, views, backend = self._filtered(state, first), first.pictures.views, first.backend
        baseline = None
        if motion.residual_threshold > 0.0:
            baseline = baseline_residual(scene, views, scale=motion.picture_scale, backend=backend)
        return FrameZeroContext(baseline, exposure_reference(scene, views, config=light) if light.enabled else None)

    def next(self, past: Past[Scene, FrameZeroContext], task: FrameTask) -> FitResult[Scene]:
        """Fit a later frame."""
        if task.begins is not None:
            return self._anew(past.state, task)
        device = task.backend.device
        return fit_next_frame(
            on_device(past.state, device),
            task.frame,
            task.rig,
            config=with_rate_control(self.config.online, task.rate_scale),
            backend=task.backend,
            seed=task.seed,
            pictures=task.pictures,
            steps=task.steps,
            baseline=past.memory.baseline,
            light=past.memory.light,
            before_previous=None if past.before_previous is None else on_device(past.before_previous, device),
            intervals=past.intervals(task.frame.pts_seconds),
            on_step=task.on_step,
        )

    def _anew(self, state: Scene, task: FrameTask) -> FitResult[Scene]:
        """Fit the first frame of another period, after the decoded ``state``."""
        initial, period = self.config.initial, self.config.period
        if period.start == "points":
            return self.first(task)
        fit = fit_first_frame_again(
            task.frame,
            task.rig,
            on_device(state, task.backend.device),
            iterations=max(round(period.share * initial.iterations), 1),
            config=initial,
            backend=task.backend,
            seed=task.seed,
            on_step=task.on_step,
        )
        return self._with_environment(fit, task)

    def residual(self, state: Scene, task: FrameTask) -> float:
        """Mean absolute difference, in 0 ... 1, of the decoded ``state`` to the frame's training pictures."""
        scale, backend = self.config.online.motion.picture_scale, task.backend
        return mean_residual(self._filtered(state, task), task.pictures.views, scale=scale, backend=backend)

    def _filtered(self, state: Scene, task: FrameTask) -> Scene:
        """The decoded ``state`` on the task's device, with the sampling of online frames."""
        sampling = RigSampling.of(task.rig) if self.config.online.sampling_filter else None
        return replace(on_device(state, task.backend.device), sampling=sampling)


def stream_pipeline(
    config: StreamConfig, *, fitted: Callable[[], FitResult[Scene]] | None = None
) -> Pipeline[Scene, FrameZeroContext]:
    """The pipeline of a configuration; see :class:`StructGStream`.

    Raises:
        ConfigError: a target rate for a codec without rate control.
    """
    if config.rate.target_mbits is not None and config.codec != "compact":
        raise ConfigError(
            f"A target of {config.rate.target_mbits:g} Mbit/s was given for a stream with codec {config.codec!r}, "
            "which has no rate control; take --preset compact, or leave the target out."
        )
    method = StructGStream(config, fitted)
    return Pipeline(
        method,
        SceneCodec(config),
        config=to_json(config),
        seed=config.seed,
        points=config.points,
        rate=config.rate,
        period=config.period,
        residual=method.residual,
        denoising=config.denoising,
    )
