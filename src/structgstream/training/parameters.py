# SPDX-License-Identifier: Apache-2.0
"""A scene as the tensors that are trained, and the quantization steps that are configured."""

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field, fields, replace

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
    scene_of,
    state_of,
    tensor_of,
    trainable,
)

# The quality multiplies a field of RoundingConfig by 2^(-quality * share); the share is 1 unless stated. For frame 0 it
# is 0.5, because its errors affect every later frame and its bytes are sent once. Fields that are no steps have 0.
_HALF_SHARE = {"quality_share": 0.5}
_NO_STEP = {"quality_share": 0.0}


@dataclass(frozen=True)
class RoundingConfig:
    """Quantization steps and price of bits for the codec ``compact``; not in the paper."""

    position_pixels: float = 0.25
    """Step of positions of anchors and free Gaussians, in pixels of a median camera at a median distance
    (:func:`pixel_size`)."""
    log_scale_step: float = 0.02
    """Step of the logarithms of anchors' scales."""
    appearance_step: float = 1 / 16
    """Step of appearance, in standard deviations of the features along a row of the basis."""
    weight_step: float = field(default=1 / 1024, metadata=_HALF_SHARE)
    """Step of the MLPs' weights after frame 0: that of frame 0, so that its weights stay as they are."""
    free_log_scale_step: float = 0.05
    """Step of the logarithms of free Gaussians' scales."""
    free_quat_step: float = 1 / 64
    """Step of the components of free Gaussians' quaternions."""
    free_logit_opacity_step: float = 0.125
    """Step of the logits of free Gaussians' opacities."""
    free_color_step: float = 1 / 128
    """Step of free Gaussians' colours, full scale 1."""
    first_noise_levels: float = field(default=0.5, metadata=_HALF_SHARE)
    """Root mean square error that quantizing frame 0 may add to the pictures, in 8-bit levels."""
    first_weight_step: float = field(default=1 / 1024, metadata=_HALF_SHARE)
    """Step of the MLPs' weights in frame 0."""
    rate_weight: float = field(default=7.5e-5, metadata=_NO_STEP)
    """What a kilobyte of changes adds to the loss."""
    free_priced: bool = field(default=False, metadata=_NO_STEP)
    """Whether bits of free Gaussians that existed in the last frame are priced too."""
    quality: float = field(default=0.0, metadata=_NO_STEP)
    """Steps are multiplied by 2^-quality and ``rate_weight`` by 4^-quality; frame 0's steps and those of MLPs by
    2^(-quality / 2)."""

    def resolved(self) -> "RoundingConfig":
        """The configuration with the quality applied to the other fields and set to 0."""
        shares = {f.name: f.metadata.get("quality_share", 1.0) for f in fields(self)}
        finer = {name: getattr(self, name) * 2.0 ** (-self.quality * share) for name, share in shares.items() if share}
        # Errors grow with the square of a step.
        return replace(self, **finer, rate_weight=self.rate_weight * 4.0**-self.quality, quality=0.0)

    def steps(self, pixel: float) -> dict[ParameterName, float]:
        """The step of every dynamic parameter; ``pixel`` is the size of a pixel in scene units (:func:`pixel_size`)."""
        plain = self.resolved()
        units = {"position_pixels": pixel}
        return {p.name: getattr(plain, p.step) * units.get(p.step, 1.0) for p in PARAMETERS if p.step}


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
    state: dict[FieldName, Tensor] = {name: value.detach().contiguous() for name, value in state_of(scene).items()}
    return scene_of(state, distance_input=scene.distance_input, sampling=scene.sampling)
