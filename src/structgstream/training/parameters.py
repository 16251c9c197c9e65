# SPDX-License-Identifier: Apache-2.0
"""A scene as the tensors that are trained, and the quantization steps that are configured."""

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import ClassVar

import torch
from torch import Tensor

from structgstream.cameras import Camera, enlargement
from structgstream.codec.fields.quantization import round_all_straight_through
from structgstream.scene.anchors import AnchorCloud
from structgstream.scene.free import FreeGaussians
from structgstream.scene.scene import Scene
from structgstream.scene.state import (
    PARAMETERS,
    FieldName,
    ParameterName,
    parameters_of,
    scene_from,
    state_of,
    tensor_of,
    trainable,
    with_state,
)


@dataclass(frozen=True)
class RoundingConfig:
    """Quantization steps and weight of the rate term for the codec ``compact``; not in the paper."""

    rate_weight: float = 7.5e-5
    """What a kilobyte of changes adds to the loss."""
    free_priced: bool = False
    """Whether the rate term also counts free Gaussians that existed in the last frame."""
    quality: float = 0.0
    """Steps are multiplied by 2^-quality and ``rate_weight`` by 4^-quality; frame 0's steps and those of MLPs by
    2^(-quality / 2)."""

    POSITION_PIXELS: ClassVar[float] = 0.25
    """Step of positions of anchors and free Gaussians, in pixels of a median camera at a median distance
    (:func:`pixel_size`)."""
    LOG_SCALE_STEP: ClassVar[float] = 0.02
    """Step of the logarithms of anchors' scales."""
    APPEARANCE_STEP: ClassVar[float] = 1 / 16
    """Step of appearance, in standard deviations of the features along a row of the basis."""
    WEIGHT_STEP: ClassVar[float] = 1 / 1024
    """Step of the MLPs' weights after frame 0: that of frame 0, so that its weights stay as they are."""
    FREE_LOG_SCALE_STEP: ClassVar[float] = 0.05
    """Step of the logarithms of free Gaussians' scales."""
    FREE_QUAT_STEP: ClassVar[float] = 1 / 64
    """Step of the components of free Gaussians' quaternions."""
    FREE_LOGIT_OPACITY_STEP: ClassVar[float] = 0.125
    """Step of the logits of free Gaussians' opacities."""
    FREE_COLOR_STEP: ClassVar[float] = 1 / 128
    """Step of free Gaussians' colours, full scale 1."""
    FIRST_NOISE_LEVELS: ClassVar[float] = 0.5
    """Root mean square error that quantizing frame 0 may add to the pictures, in 8-bit levels."""
    FIRST_WEIGHT_STEP: ClassVar[float] = 1 / 1024
    """Step of the MLPs' weights in frame 0."""
    HALF_QUALITY: ClassVar[frozenset[str]] = frozenset({"first_noise_levels", "first_weight_step", "weight_step"})
    """These follow half of the quality, because errors of frame 0 affect every later frame and its bytes are sent
    once."""

    def at_quality(self, name: str) -> float:
        """The constant of this name, in lower case, multiplied by 2^-quality, or 2^(-quality / 2)."""
        share = 0.5 if name in self.HALF_QUALITY else 1.0
        return getattr(self, name.upper()) * 2.0 ** (-self.quality * share)

    @property
    def resolved_rate_weight(self) -> float:
        """``rate_weight`` at the quality: errors grow with the square of a step."""
        return self.rate_weight * 4.0**-self.quality

    def steps(self, pixel: float) -> dict[ParameterName, float]:
        """The step in packets of every parameter that can be quantized, dynamic or not; ``pixel`` is the size of a
        pixel in scene units (:func:`pixel_size`)."""
        units = {"position_pixels": pixel}
        return {p.name: self.at_quality(p.step) * units.get(p.step, 1.0) for p in PARAMETERS if p.step}


def pixel_size(positions: Tensor, cameras: Iterable[Camera]) -> float | None:
    """Size of a pixel of a picture of the reference size, in scene units, at the median distance of the anchors for the
    median camera.

    Args:
        positions: ``[M, 3]`` of anchors.
        cameras: of the training views, in units of the scene.

    Returns:
        None if no camera sees an anchor.
    """
    sizes, positions = [], positions.cpu()  # A GPU would be waited for four times a camera.
    for camera in cameras:
        viewmat, K = camera.viewport(positions)[:2]
        points = positions @ viewmat[:3, :3].T + viewmat[:3, 3]
        pixels = (points @ K.T)[:, :2] / points[:, 2:]
        size = pixels.new_tensor([camera.width, camera.height])
        seen = (points[:, 2] > camera.near) & ((pixels >= 0) & (pixels < size)).all(1)
        if seen.any():
            enlarged = enlargement(camera.width, camera.height)
            sizes.append(enlarged * float(points[seen, 2].median() / K[0, 0]))
    return float(torch.tensor(sizes).median()) if sizes else None


ANCHOR_ROWS, FREE_ROWS, CAMERA_ROWS = trainable("anchor"), trainable("free"), trainable("camera")


def parameters_of_fields(names: Iterable[FieldName]) -> frozenset[ParameterName]:
    """The trainable parameters of the fields ``names``."""
    return frozenset(p.name for p in parameters_of(names) if p.trainable)


def values_of_rows(rows: AnchorCloud | FreeGaussians, names: Collection[ParameterName]) -> dict[ParameterName, Tensor]:
    """The tensors of the parameters ``names``, of anchors or of free Gaussians, in ``rows``."""
    found: dict[ParameterName, Tensor] = {}
    for parameter in PARAMETERS:
        if parameter.name in names and (value := getattr(rows, parameter.attribute)) is not None:
            found[parameter.name] = value
    return found


@dataclass
class Parameters:
    """Leaf tensors by name: the mutable state of a fit, which is not visible outside of it.

    ``values[name].requires_grad`` says whether the name is trained.
    """

    values: dict[ParameterName, Tensor]
    births: Tensor
    steps: Mapping[ParameterName, float] = field(default_factory=dict)

    @classmethod
    def of(
        cls, scene: Scene, *, trained: frozenset[ParameterName], steps: Mapping[ParameterName, float] | None = None
    ) -> "Parameters":
        """Copies of a scene's tensors; ``trained`` ones have gradients, those in ``steps`` are drawn quantized."""
        copies: dict[ParameterName, Tensor] = {
            p.name: value.detach().clone().contiguous().requires_grad_(p.name in trained)
            for p in PARAMETERS
            if p.trainable and (value := tensor_of(scene, p)) is not None
        }
        known: dict[ParameterName, float] = {name: step for name, step in (steps or {}).items() if name in copies}
        return cls(copies, scene.free.births.clone(), known)

    def scene(self, template: Scene) -> Scene:
        """The scene with these parameters; differentiable. Other attributes are those of ``template``."""
        values: dict[ParameterName, Tensor] = {
            p.name: value for p in PARAMETERS if not p.trainable and (value := tensor_of(template, p)) is not None
        }
        values |= {**self.values, "free_births": self.births}
        rounded = round_all_straight_through([self.values[name] for name in self.steps], [*self.steps.values()])
        values |= dict(zip(self.steps, rounded, strict=True))
        found = scene_from(values, distance_input=template.distance_input, sampling=template.sampling)
        found = replace(found, anchor_intervals=template.anchor_intervals)
        gauged = any(self.values[name].requires_grad for name in CAMERA_ROWS)
        return replace(found, camera_color=found.camera_color.gauged()) if gauged else found


def detached(scene: Scene) -> Scene:
    """The same scene without a gradient graph."""
    return with_state(scene, {name: value.detach().contiguous() for name, value in state_of(scene).items()})
