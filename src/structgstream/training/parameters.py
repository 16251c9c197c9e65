# SPDX-License-Identifier: Apache-2.0
"""A scene taken apart into the tensors that an optimiser moves, and put together again."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

from torch import Tensor

from structgstream.scene.color import CameraColor
from structgstream.scene.free import FreeGaussians
from structgstream.scene.scene import Scene
from structgstream.scene.state import FieldName, flatten_head, scene_of, state_of, unflatten_head
from structgstream.training.rounding import rounded

ParameterName = Literal[
    "anchor_positions",
    "offset_scales",
    "base_scales",
    "anchor_offsets",
    "anchor_features",
    "appearance",
    "opacity_mlp",
    "color_mlp",
    "covariance_mlp",
    "free_means",
    "free_log_scales",
    "free_quats",
    "free_logit_opacities",
    "free_colors",
    "camera_gains",
    "camera_biases",
]

ANCHOR_ROWS: tuple[ParameterName, ...] = (
    "anchor_positions",
    "offset_scales",
    "base_scales",
    "anchor_offsets",
    "anchor_features",
    "appearance",
)
FREE_ROWS: tuple[ParameterName, ...] = (
    "free_means",
    "free_log_scales",
    "free_quats",
    "free_logit_opacities",
    "free_colors",
)
_OF_FIELD: dict[FieldName, tuple[ParameterName, ...]] = {
    "free": FREE_ROWS,
    "camera_color": ("camera_gains", "camera_biases"),
}


def parameters_of_fields(names: Iterable[FieldName]) -> frozenset[ParameterName]:
    """The parameters behind rows of the state table (``free_births`` is an identity, not a parameter)."""
    found: set[ParameterName] = set()
    for name in names:
        if name in _OF_FIELD:
            found.update(_OF_FIELD[name])
        elif name != "free_births":
            found.add(name)  # type: ignore[arg-type]
    return frozenset(found)


def free_rows(free: FreeGaussians) -> dict[ParameterName, Tensor]:
    """The rows of :data:`FREE_ROWS` that stand for ``free``."""
    return {
        "free_means": free.means,
        "free_log_scales": free.log_scales,
        "free_quats": free.quats,
        "free_logit_opacities": free.logit_opacities,
        "free_colors": free.colors,
    }


@dataclass
class Parameters:
    """Leaf tensors by name. The one mutable thing of a fit; it never leaves it.

    ``values[name].requires_grad`` says whether the name is trained.
    """

    values: dict[ParameterName, Tensor]
    births: Tensor
    distance_input: bool
    steps: Mapping[ParameterName, float] = field(default_factory=dict)

    @classmethod
    def of(
        cls, scene: Scene, *, trained: frozenset[ParameterName], steps: Mapping[ParameterName, float] | None = None
    ) -> "Parameters":
        """Copies of a scene's tensors; those in ``trained`` collect gradients, those in ``steps`` are drawn rounded."""
        free = scene.free
        values: dict[ParameterName, Tensor] = {
            "anchor_positions": scene.anchors.positions,
            "offset_scales": scene.anchors.log_offset_scales,
            "base_scales": scene.anchors.log_base_scales,
            "anchor_offsets": scene.anchors.offsets,
            "anchor_features": scene.anchors.features,
            "appearance": scene.anchors.appearance,
            "opacity_mlp": flatten_head(scene.mlps.opacity),
            "color_mlp": flatten_head(scene.mlps.color),
            "covariance_mlp": flatten_head(scene.mlps.covariance),
            "free_means": free.means,
            "free_log_scales": free.log_scales,
            "free_quats": free.quats,
            "free_logit_opacities": free.logit_opacities,
            "free_colors": free.colors,
            "camera_gains": scene.camera_color.gains,
            "camera_biases": scene.camera_color.biases,
        }
        copies: dict[ParameterName, Tensor] = {
            name: value.detach().clone().contiguous().requires_grad_(name in trained) for name, value in values.items()
        }
        return cls(copies, free.births.clone(), scene.distance_input, dict(steps or {}))

    def scene(self, template: Scene) -> Scene:
        """The scene these parameters stand for; differentiable. ``template`` gives the MLPs' widths."""
        v = self.values | {name: rounded(self.values[name], step) for name, step in self.steps.items()}

        def head(name: Literal["opacity", "color", "covariance"], vector: Tensor):
            like = getattr(template.mlps, name)
            return unflatten_head(vector, like.w1.shape[1], like.w2.shape[0], like.w1.shape[0])

        color = CameraColor(v["camera_gains"], v["camera_biases"])
        return replace(
            template,
            anchors=replace(
                template.anchors,
                positions=v["anchor_positions"],
                log_offset_scales=v["offset_scales"],
                log_base_scales=v["base_scales"],
                offsets=v["anchor_offsets"],
                features=v["anchor_features"],
                appearance=v["appearance"],
            ),
            mlps=template.mlps._replace(
                opacity=head("opacity", v["opacity_mlp"]),
                color=head("color", v["color_mlp"]),
                covariance=head("covariance", v["covariance_mlp"]),
            ),
            free=FreeGaussians(
                v["free_means"],
                v["free_log_scales"],
                v["free_quats"],
                v["free_logit_opacities"],
                v["free_colors"],
                self.births,
            ),
            camera_color=color.gauged() if v["camera_gains"].requires_grad else color,
        )


def detached(scene: Scene) -> Scene:
    """The same scene without a gradient graph."""
    state: dict[FieldName, Tensor] = {name: value.detach().contiguous() for name, value in state_of(scene).items()}
    return scene_of(state, distance_input=scene.distance_input)
