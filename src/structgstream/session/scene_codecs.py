# SPDX-License-Identifier: Apache-2.0
"""The two codecs of scenes, ``raw`` and ``compact``, and their headers."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import torch

from structgstream.codec.encoder import SceneEncoder
from structgstream.codec.fields.quantization import float32, round_to_bins
from structgstream.codec.packets import StreamHeader
from structgstream.codec.reader import StreamReader
from structgstream.codec.sinks import FileSink
from structgstream.errors import CalibrationError
from structgstream.scene.appearance import with_appearance
from structgstream.scene.order import in_morton_order
from structgstream.scene.scene import Scene
from structgstream.scene.state import FieldName, fields_of, parameters_of, scene_of, state_of, with_dynamic_fields
from structgstream.session.pipeline import FrameTask, StreamFacts
from structgstream.session.presets import StreamConfig
from structgstream.training.frame0.quantization import estimate_sensitivity, quantize_first_frame, regauge
from structgstream.training.parameters import pixel_size


@dataclass(frozen=True)
class QuantizationSteps:
    """Quantization steps of a stream, as stored in the header; empty with codec ``raw``."""

    steps: Mapping[str, float] = field(default_factory=dict)  # steps of packets, by parameter
    init_steps: Mapping[FieldName, float] = field(default_factory=dict)  # steps of the init record, by field


@dataclass(frozen=True)
class SceneCodec(ABC):
    """Common part of both codecs: the file, the coder and the header."""

    config: StreamConfig

    @property
    def name(self) -> str:
        """The value of the header's ``codec``."""
        return self.config.codec

    def key_interval(self, fps: float) -> int:
        """Frames from one key packet to the next."""
        return max(1, round(fps * self.config.key_interval_seconds))

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
        """The encoder of the stream, on the CPU."""
        return SceneEncoder(header)

    def prepare(self, fitted: Scene, task: FrameTask, facts: StreamFacts) -> tuple[Scene, StreamHeader]:
        """The reconstruction of a period's first frame, which later frames and receivers use, and its header."""
        scene, step_sizes = self._initialize_stream(fitted, task)
        state, dynamic = state_of(scene), self.config.online.dynamic
        reference = dynamic.difference(fields_of("free")) if step_sizes.steps else ()
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
            steps=step_sizes.steps,
            reference={name: state[name].cpu() for name in reference},
            init_steps=step_sizes.init_steps,
            periods=self.config.period.enabled,
        )
        return scene, header

    @abstractmethod
    def _initialize_stream(self, scene: Scene, task: FrameTask) -> tuple[Scene, QuantizationSteps]:
        """The reconstruction of frame 0, as a receiver decodes it, and its steps."""

    def _with_dynamic_fields(self, scene: Scene) -> Scene:
        """``scene`` with all dynamic fields; dynamic appearance gets its basis."""
        online = self.config.online
        if "appearance" in online.dynamic:
            scene = with_appearance(scene, online.appearance_rank)
        return with_dynamic_fields(scene, online.dynamic)


@dataclass(frozen=True)
class RawCodec(SceneCodec):
    """Stores every number as float32."""

    def _initialize_stream(self, scene: Scene, task: FrameTask) -> tuple[Scene, QuantizationSteps]:
        return self._with_dynamic_fields(scene), QuantizationSteps()


@dataclass(frozen=True)
class CompactCodec(SceneCodec):
    """All values are quantized (``codec/fields/quantization.py``, Note [Bins]); anchors are in Z-order."""

    def _initialize_stream(self, scene: Scene, task: FrameTask) -> tuple[Scene, QuantizationSteps]:
        dynamic, rounding = self.config.online.dynamic, self.config.online.rounding
        scene, sensitivity = regauge(scene, estimate_sensitivity(scene, task.rig, backend=task.backend, seed=task.seed))
        scene = self._with_dynamic_fields(scene)
        pixel = pixel_size(scene.anchors.positions, [task.rig[name] for name in task.rig.training])
        if pixel is None:
            raise CalibrationError(
                "No training camera sees an anchor of frame 0, so positions have no step; check the calibration with "
                "structgstream prepare --check."
            )
        known = rounding.steps(pixel)
        used = {parameter.name for parameter in parameters_of(dynamic)}
        steps = {name: float32(step) for name, step in known.items() if name in used}
        voxel_size = self.config.initial.voxel_size
        scene, init_steps = quantize_first_frame(
            scene, sensitivity, config=rounding, voxel_size=voxel_size, steps=steps
        )
        if scene.environment is not None:
            init_steps["environment"] = float32(self.config.environment.STEP)
        rounded = round_to_bins(state_of(in_morton_order(scene, step=init_steps["anchor_positions"])), init_steps)
        return scene_of(rounded, distance_input=scene.distance_input, sampling=scene.sampling), QuantizationSteps(
            steps, init_steps
        )


def scene_codec(config: StreamConfig) -> SceneCodec:
    """The codec of the configuration."""
    return RawCodec(config) if config.codec == "raw" else CompactCodec(config)
