# SPDX-License-Identifier: Apache-2.0
"""The method Struct-GStream: frame 0 from initial points, each later frame from the decoded previous one."""

from collections.abc import Callable
from dataclasses import dataclass, replace

from structgstream.cameras import CameraRig
from structgstream.errors import ConfigError
from structgstream.frames import MultiViewFrame
from structgstream.kernels.backend import Backend
from structgstream.scene.sampling import RigSampling
from structgstream.scene.scene import Scene
from structgstream.scene.state import on_device
from structgstream.session.pipeline import FrameTask, Past, Pipeline
from structgstream.session.presets import StreamConfig, to_json
from structgstream.session.rate_control import with_rate_control
from structgstream.session.scene_codecs import scene_codec
from structgstream.training.frame0.fit import fit_first_frame, fit_first_frame_again
from structgstream.training.frame0.seeding import fit_environment
from structgstream.training.online.exposure import ExposureReference, exposure_reference
from structgstream.training.online.fit import fit_next_frame, needs_older
from structgstream.training.online.preprocess import FramePictures, preprocess
from structgstream.training.residuals import ResidualFloor, mean_residual, residual_floor
from structgstream.training.result import FitResult


@dataclass(frozen=True)
class FrameZeroContext:
    """The data of a period's first frame that later frames need in addition to its scene; None if not used."""

    floor: ResidualFloor | None = None  # baseline residuals
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
    def needs_older(self) -> bool:
        """See ``training.online.needs_older``."""
        return needs_older(self.config.online)

    def observe(
        self, frame: MultiViewFrame, before: MultiViewFrame | None, *, rig: CameraRig, backend: Backend
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
            )
        return self._with_environment(fit, task)

    def _with_environment(self, fit: FitResult[Scene], task: FrameTask) -> FitResult[Scene]:
        config, backend = self.config, task.backend
        if not config.environment.enabled:
            return fit
        views = task.pictures.views
        found = fit_environment(fit.scene, views, config=config.environment, backend=backend)
        return replace(fit, scene=replace(fit.scene, environment=found))

    def prepare(self, state: Scene, task: Callable[[], FrameTask]) -> FrameZeroContext:
        """The baseline residuals of frame 0, if residuals are used, and its exposure reference, if it is needed."""
        motion, light = self.config.online.motion, self.config.online.exposure
        if motion.residual_threshold <= 0.0 and not light.enabled:
            return FrameZeroContext()
        first = task()
        scene, views, backend = self._filtered(state, first), first.pictures.views, first.backend
        floor = None
        if motion.residual_threshold > 0.0:
            floor = residual_floor(scene, views, scale=motion.picture_scale, backend=backend)
        return FrameZeroContext(floor, exposure_reference(scene, views, config=light) if light.enabled else None)

    def next(self, past: Past[Scene, FrameZeroContext], task: FrameTask) -> FitResult[Scene]:
        """Fit a later frame."""
        if task.begins is not None:
            return self._anew(past.state, task)
        device = task.backend.device
        return fit_next_frame(
            on_device(past.state, device),
            task.frame,
            task.rig,
            config=with_rate_control(self.config.online, task.pressure),
            backend=task.backend,
            seed=task.seed,
            pictures=task.pictures,
            steps=task.steps,
            floor=past.memory.floor,
            light=past.memory.light,
            older=None if past.older is None else on_device(past.older, device),
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
        scene_codec(config),
        config=to_json(config),
        seed=config.seed,
        normalised_radius=config.NORMALISED_RADIUS,
        points=config.points,
        rate=config.rate,
        period=config.period,
        residual=method.residual,
        denoising=config.denoising,
    )
