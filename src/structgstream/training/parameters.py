# SPDX-License-Identifier: Apache-2.0
"""A scene as the tensors that the optimiser trains, and back."""

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field, replace

from torch import Tensor

from structgstream.scene.anchors import AnchorCloud
from structgstream.scene.free import FreeGaussians
from structgstream.scene.scene import Scene
from structgstream.scene.state import (
    PARAMETERS,
    FieldName,
    Granularity,
    ParameterName,
    fields_of,
    parameters_of,
    scene_from,
    scene_of,
    state_of,
    tensor_of,
)
from structgstream.training.rounding import round_all_straight_through


def trainable(*granularities: Granularity) -> tuple[ParameterName, ...]:
    """The trainable parameters of the fields of ``granularities``, in the order of the state table."""
    return tuple(p.name for p in parameters_of(fields_of(*granularities)) if p.trainable)


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
