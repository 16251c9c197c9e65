# SPDX-License-Identifier: Apache-2.0
"""The state table: every piece of a scene, and whether it lives for a stream or for a frame.

Note [State table]
~~~~~~~~~~~~~~~~~~
Four subsystems read this one table instead of each keeping a list: the optimiser trains the dynamic fields, the
stream's init record carries the static ones, packets carry the dynamic ones, and size accounting sums over both. Half
of the paper's ablations are edits of the dynamic set.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from structgstream.kernels.anchor_types import HeadWeights, MLPWeights
from structgstream.scene.anchors import AnchorCloud
from structgstream.scene.color import CameraColor
from structgstream.scene.free import FreeGaussians
from structgstream.scene.scene import Scene

FieldName = Literal[
    "anchor_positions",
    "offset_scales",
    "base_scales",
    "anchor_offsets",
    "anchor_features",
    "opacity_mlp",
    "color_mlp",
    "covariance_mlp",
    "free",
    "free_births",
    "camera_color",
    "appearance",
    "appearance_basis",
    "environment",
]


@dataclass(frozen=True)
class StateField:
    """One row of the table.

    Args:
        name: the field's name in streams, reports and configurations.
        code: its number in a stream; never reused.
        symbol: the paper's symbol.
        dynamic: whether the paper changes it after frame 0.
        optional: whether a scene may do without it.
    """

    name: FieldName
    code: int
    symbol: str
    dynamic: bool
    optional: bool = False


STATE_TABLE: tuple[StateField, ...] = (
    StateField("anchor_positions", 1, "x_v", True),
    StateField("offset_scales", 2, "l_v", True),
    StateField("base_scales", 3, "l_v (second half)", False),
    StateField("anchor_offsets", 4, "O_v", False),
    StateField("anchor_features", 5, "f_v", False),
    StateField("opacity_mlp", 6, "F_alpha", False),
    StateField("color_mlp", 7, "F_c", False),
    StateField("covariance_mlp", 8, "F_Sigma", True),
    StateField("free", 9, "free 3DGs", True),
    StateField("free_births", 10, "free 3DGs", True),
    StateField("camera_color", 11, "-", False),
    StateField("appearance", 12, "-", False, optional=True),
    StateField("appearance_basis", 13, "-", False, optional=True),
    StateField("environment", 14, "-", False, optional=True),
)

REQUIRED: frozenset[FieldName] = frozenset(f.name for f in STATE_TABLE if not f.optional)
PAPER_DYNAMIC: frozenset[FieldName] = frozenset(f.name for f in STATE_TABLE if f.dynamic)
FREE_COLUMNS = 14  # mean 3, log-scale 3, quaternion 4, logit opacity 1, colour 3


def flatten_head(head: HeadWeights) -> Tensor:
    """All weights of one MLP as one vector: w1, b1, w2, b2, each row by row."""
    return torch.cat([weight.reshape(-1) for weight in head])


def unflatten_head(vector: Tensor, inputs: int, outputs: int, hidden: int) -> HeadWeights:
    """The inverse of :func:`flatten_head` for a head of the given widths."""
    sizes = (hidden * inputs, hidden, outputs * hidden, outputs)
    w1, b1, w2, b2 = vector.split(sizes)
    return HeadWeights(w1.reshape(hidden, inputs), b1, w2.reshape(outputs, hidden), b2)


def state_of(scene: Scene) -> dict[FieldName, Tensor]:
    """The scene as named tensors, one for each row of the table that it has."""
    anchors, free, color = scene.anchors, scene.free, scene.camera_color
    state: dict[FieldName, Tensor] = {
        "anchor_positions": anchors.positions,
        "offset_scales": anchors.log_offset_scales,
        "base_scales": anchors.log_base_scales,
        "anchor_offsets": anchors.offsets,
        "anchor_features": anchors.features,
        "opacity_mlp": flatten_head(scene.mlps.opacity),
        "color_mlp": flatten_head(scene.mlps.color),
        "covariance_mlp": flatten_head(scene.mlps.covariance),
        "free": torch.cat([free.means, free.log_scales, free.quats, free.logit_opacities[:, None], free.colors], dim=1),
        "free_births": free.births,
        "camera_color": torch.cat([color.gains, color.biases], dim=1),
    }
    if len(scene.appearance_basis):
        state |= {"appearance": anchors.appearance, "appearance_basis": scene.appearance_basis}
    if scene.environment is not None:
        state["environment"] = scene.environment
    return state


def scene_of(state: Mapping[FieldName, Tensor], *, distance_input: bool) -> Scene:
    """The inverse of :func:`state_of`; nothing is copied that a view can give."""
    features, offsets = state["anchor_features"], state["anchor_offsets"]
    k = offsets.shape[1]
    inputs = features.shape[1] + 3 + int(distance_input)
    hidden = state["opacity_mlp"].shape[0] - k
    hidden //= inputs + 1 + k
    means, log_scales, quats, logits, colors = state["free"].split((3, 3, 4, 1, 3), dim=1)
    gains, biases = state["camera_color"].split((3, 3), dim=1)
    anchors = AnchorCloud(
        positions=state["anchor_positions"],
        log_offset_scales=state["offset_scales"],
        log_base_scales=state["base_scales"],
        offsets=offsets,
        features=features,
        appearance=state.get("appearance", features[:, :0]),
    )
    return Scene(
        anchors=anchors,
        mlps=MLPWeights(
            opacity=unflatten_head(state["opacity_mlp"], inputs, k, hidden),
            color=unflatten_head(state["color_mlp"], inputs, 3 * k, hidden),
            covariance=unflatten_head(state["covariance_mlp"], inputs, 7 * k, hidden),
        ),
        free=FreeGaussians(means, log_scales, quats, logits[:, 0], colors, state["free_births"]),
        camera_color=CameraColor(gains, biases),
        appearance_basis=state.get("appearance_basis", features[:0]),
        distance_input=distance_input,
        environment=state.get("environment"),
    )


def on_device(scene: Scene, device: torch.device) -> Scene:
    """The scene with its tensors on ``device``."""
    if device.type == "cpu":
        return scene
    state: dict[FieldName, Tensor] = {name: value.to(device) for name, value in state_of(scene).items()}
    return scene_of(state, distance_input=scene.distance_input)
