# SPDX-License-Identifier: Apache-2.0
"""The state table: for each field of a scene its attribute, lifetime, shape, learning rates and coding.

Note [State table]
~~~~~~~~~~~~~~~~~~
This is the only list of fields. The optimiser reads the parameters of the dynamic fields and their learning rates from
it; ``codec/fields`` rounds them, estimates the rate of their changes and codes them, by their rows alone. The init
record contains the static fields and packets the dynamic ones, in the coding stated here. A third of the paper's
ablations are edits of the dynamic set. The order of rows is the order of fields in a stream.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import torch
from torch import Tensor

from structgstream.errors import ConfigError
from structgstream.kernels.values import HeadWeights, MLPWeights
from structgstream.scene.anchors import AnchorCloud
from structgstream.scene.color import CameraColor
from structgstream.scene.free import FreeGaussians
from structgstream.scene.sampling import RigSampling
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
ParameterName = (
    FieldName
    | Literal[
        "free_means",
        "free_log_scales",
        "free_quats",
        "free_logit_opacities",
        "free_colors",
        "camera_gains",
        "camera_biases",
    ]
)
Granularity = Literal["anchor", "free", "camera", "shared"]
"""The object that a row of a field describes; ``shared`` fields belong to the whole scene."""
InitCoding = Literal["uncoded", "positions", "rows", "numbers"]
"""Coding of a field in the init record of a compact stream (docs/bitstream.md, section Coded init fields)."""


@dataclass(frozen=True)
class Parameter:
    """A tensor with its own learning rate and quantization step: a field, or some columns of one.

    Args:
        name: its name in configurations and in the header's steps.
        path: path of the attribute in a :class:`Scene`.
        columns: number of its columns in the field; one column is a vector in the scene. 0: the whole field.
        step: the constant of ``RoundingConfig``, in lower case, with its quantization step after frame 0; None: never
            quantized.
        online_rate: the constant of ``OnlineRates``, in lower case, with its learning rate after frame 0; None: not
            trained.
        first_rate: the field of ``InitialRates`` with its learning rate in frame 0; None: not trained.
    """

    name: ParameterName
    path: str
    columns: int = 0
    step: str | None = None
    online_rate: str | None = None
    first_rate: str | None = None

    @property
    def trainable(self) -> bool:
        """Whether it has a learning rate."""
        return self.online_rate is not None or self.first_rate is not None

    @cached_property
    def holder(self) -> str:
        """The part of the scene that has the attribute; empty for the scene itself."""
        return self.path.rpartition(".")[0]

    @cached_property
    def attribute(self) -> str:
        """The attribute's name in :attr:`holder`."""
        return self.path.rpartition(".")[2]


@dataclass(frozen=True)
class StateField:
    """One row of the table.

    Args:
        name: the field's name in streams, reports and configurations.
        code: its number in a stream; never reused.
        symbol: the paper's symbol.
        granularity: the object that a row describes.
        shape: numbers, and letters that denote the same size in all fields (docs/bitstream.md, section Fields).
        path: path of the attribute in a :class:`Scene`; empty for a field with ``parts``.
        parts: the parameters whose columns make up the field, if it is not a single parameter.
        dynamic: whether the paper trains it after frame 0.
        optional: group of optional fields, which are present together or not at all. None: required.
        integers: whether the values are int64 instead of float32.
        outputs: an MLP's outputs per structured Gaussian; 0 for other fields.
        init_coding: coding in the init record of a compact stream.
        step, online_rate, first_rate: as in :class:`Parameter`.
        init_step: the constant of ``RoundingConfig``, in lower case, with its step in frame 0; ``sensitivity``: chosen
            from the sensitivity of the renderings; ``own``: chosen by the code that makes the field. None: as ``step``.
    """

    name: FieldName
    code: int
    symbol: str
    granularity: Granularity
    shape: tuple[str | int, ...]
    path: str = ""
    parts: tuple[Parameter, ...] = ()
    dynamic: bool = False
    optional: str | None = None
    integers: bool = False
    outputs: int = 0
    init_coding: InitCoding = "uncoded"
    step: str | None = None
    online_rate: str | None = None
    first_rate: str | None = None
    init_step: str | None = None

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        """The parts, or the whole field as the only parameter."""
        return self.parts or (Parameter(self.name, self.path, 0, self.step, self.online_rate, self.first_rate),)

    @property
    def quantized(self) -> bool:
        """Whether packets of a compact stream can contain the field, as quantization indices."""
        return all(parameter.step for parameter in self.parameters)


STATE_TABLE: tuple[StateField, ...] = (
    StateField(
        "anchor_positions", 1, "x_v", "anchor", ("M", 3), "anchors.positions", dynamic=True,
        init_coding="positions", init_step="own",
        step="position_pixels", online_rate="anchor_positions",
    ),
    StateField(
        "offset_scales", 2, "l_v", "anchor", ("M", 3), "anchors.log_offset_scales", dynamic=True,
        init_coding="rows", step="log_scale_step", online_rate="offset_scales", first_rate="scales",
    ),
    StateField(
        "base_scales", 3, "l_v (second half)", "anchor", ("M", 3), "anchors.log_base_scales",
        init_coding="rows", init_step="sensitivity",
        step="log_scale_step", online_rate="base_scales", first_rate="scales",
    ),
    StateField(
        "anchor_offsets", 4, "O_v", "anchor", ("M", "K", 3), "anchors.offsets",
        init_coding="rows", init_step="sensitivity", online_rate="anchor_offsets", first_rate="offsets",
    ),
    StateField(
        "anchor_features", 5, "f_v", "anchor", ("M", "D"), "anchors.features",
        init_coding="rows", init_step="sensitivity", online_rate="anchor_features", first_rate="features",
    ),
    StateField(
        "opacity_mlp", 6, "F_alpha", "shared", ("P_alpha",), "mlps.opacity", outputs=1,
        init_coding="numbers", init_step="first_weight_step",
        step="weight_step", online_rate="opacity_mlp", first_rate="opacity_mlp",
    ),
    StateField(
        "color_mlp", 7, "F_c", "shared", ("P_c",), "mlps.color", outputs=3,
        init_coding="numbers", init_step="first_weight_step",
        step="weight_step", online_rate="color_mlp", first_rate="color_mlp",
    ),
    StateField(
        "covariance_mlp", 8, "F_Sigma", "shared", ("P_Sigma",), "mlps.covariance", dynamic=True, outputs=7,
        init_coding="numbers", init_step="first_weight_step",
        step="weight_step", online_rate="covariance_mlp", first_rate="covariance_mlp",
    ),
    StateField(
        "free", 9, "free 3DGs", "free", ("F", 14), dynamic=True,
        parts=(
            Parameter("free_means", "free.means", 3, "position_pixels", "free_means"),
            Parameter("free_log_scales", "free.log_scales", 3, "free_log_scale_step", "free_log_scales"),
            Parameter("free_quats", "free.quats", 4, "free_quat_step", "free_quats"),
            Parameter("free_logit_opacities", "free.logit_opacities", 1, "free_logit_opacity_step",
                      "free_logit_opacities"),
            Parameter("free_colors", "free.colors", 3, "free_color_step", "free_colors"),
        ),
    ),
    StateField("free_births", 10, "free 3DGs", "free", ("F",), "free.births", dynamic=True, integers=True),
    StateField(
        "camera_color", 11, "-", "camera", ("V", 6),
        parts=(
            Parameter("camera_gains", "camera_color.gains", 3, first_rate="camera_color"),
            Parameter("camera_biases", "camera_color.biases", 3, first_rate="camera_color"),
        ),
    ),
    StateField(
        "appearance", 12, "-", "anchor", ("M", "R"), "anchors.appearance", optional="appearance",
        init_coding="rows", step="appearance_step", online_rate="appearance",
    ),
    StateField(
        "appearance_basis", 13, "-", "shared", ("R", "D"), "appearance_basis", optional="appearance",
        init_coding="numbers", init_step="own",
    ),
    StateField(
        "environment", 14, "-", "shared", ("E", 3), "environment", optional="environment",
        init_coding="numbers", init_step="own",
    ),
)  # fmt: skip

FIELDS: Mapping[FieldName, StateField] = {row.name: row for row in STATE_TABLE}
PARAMETERS: tuple[Parameter, ...] = tuple(parameter for row in STATE_TABLE for parameter in row.parameters)
PAPER_DYNAMIC: frozenset[FieldName] = frozenset(row.name for row in STATE_TABLE if row.dynamic)
FREE_COLUMNS = sum(parameter.columns for parameter in FIELDS["free"].parts)
_PARTS_OF_SCENE = {"anchors": AnchorCloud, "mlps": MLPWeights, "free": FreeGaussians, "camera_color": CameraColor}


def fields_of(*granularities: Granularity) -> tuple[FieldName, ...]:
    """The names of the fields of these granularities, in the table's order."""
    return tuple(row.name for row in STATE_TABLE if row.granularity in granularities)


def parameters_of(names: Iterable[FieldName]) -> tuple[Parameter, ...]:
    """The parameters of the fields ``names``, in that order."""
    return tuple(parameter for name in names for parameter in FIELDS[name].parameters)


def trainable(*granularities: Granularity) -> tuple[ParameterName, ...]:
    """The trainable parameters of the fields of ``granularities``, in the table's order."""
    return tuple(p.name for p in parameters_of(fields_of(*granularities)) if p.trainable)


def flatten_head(head: HeadWeights) -> Tensor:
    """All weights of one MLP as one vector: w1, b1, w2, b2, each row by row."""
    return torch.cat([weight.reshape(-1) for weight in head])


def unflatten_head(vector: Tensor, inputs: int, outputs: int) -> HeadWeights:
    """The inverse of :func:`flatten_head` for a head of the given widths."""
    hidden = (len(vector) - outputs) // (inputs + 1 + outputs)
    w1, b1, w2, b2 = vector.split((hidden * inputs, hidden, outputs * hidden, outputs))
    return HeadWeights(w1.reshape(hidden, inputs), b1, w2.reshape(outputs, hidden), b2)


def tensor_of(scene: Scene, parameter: Parameter) -> Tensor | None:
    """A parameter's tensor in ``scene``, an MLP as one vector; None if the scene lacks this optional field."""
    value = getattr(getattr(scene, parameter.holder) if parameter.holder else scene, parameter.attribute)
    return flatten_head(value) if isinstance(value, HeadWeights) else value


def state_of(scene: Scene) -> dict[FieldName, Tensor]:
    """The scene as named tensors, one per field that it has."""
    state: dict[FieldName, Tensor] = {}
    for row in STATE_TABLE:
        found = [(p, value) for p in row.parameters if (value := tensor_of(scene, p)) is not None]
        if row.parts:
            state[row.name] = torch.cat([value.reshape(len(value), p.columns) for p, value in found], dim=1)
        elif found:
            state[row.name] = found[0][1]
    return state


def scene_of(state: Mapping[FieldName, Tensor], *, distance_input: bool, sampling: RigSampling | None = None) -> Scene:
    """The inverse of :func:`state_of`; tensors are views where possible."""
    values: dict[ParameterName, Tensor] = {}
    for name, value in state.items():
        row = FIELDS[name]
        columns = value.split([p.columns for p in row.parts], dim=1) if row.parts else (value,)
        for parameter, tensor in zip(row.parameters, columns, strict=True):
            values[parameter.name] = tensor[:, 0] if parameter.columns == 1 else tensor
    return scene_from(values, distance_input=distance_input, sampling=sampling)


def with_state(scene: Scene, state: Mapping[FieldName, Tensor]) -> Scene:
    """``scene`` with the tensors ``state``, and without ``anchor_intervals``."""
    return scene_of(state, distance_input=scene.distance_input, sampling=scene.sampling)


def scene_from(
    values: Mapping[ParameterName, Tensor], *, distance_input: bool, sampling: RigSampling | None = None
) -> Scene:
    """The scene whose parameters have the tensors ``values`` (:func:`tensor_of`)."""
    k, inputs = values["anchor_offsets"].shape[1], values["anchor_features"].shape[1] + 3 + int(distance_input)
    found: dict[str, Any] = {holder: {} for holder in _PARTS_OF_SCENE}
    for row in STATE_TABLE:
        for parameter in row.parameters:
            value: Any = values.get(parameter.name)
            if value is None:
                continue
            if row.outputs:
                value = unflatten_head(value, inputs, row.outputs * k)
            (found[parameter.holder] if parameter.holder else found)[parameter.attribute] = value
    for holder, kind in _PARTS_OF_SCENE.items():
        found[holder] = kind(**found[holder])
    return Scene(**found, distance_input=distance_input, sampling=sampling)


def with_dynamic_fields(scene: Scene, dynamic: Iterable[FieldName]) -> Scene:
    """``scene`` with zeros for those optional anchor fields of ``dynamic`` that it lacks.

    Raises:
        ConfigError: a missing field is not an anchor field, or its number of columns is not fixed by the table.
    """
    state = state_of(scene)
    missing = [FIELDS[name] for name in dynamic if name not in state]
    for row in missing:
        columns = [size for size in row.shape[1:] if isinstance(size, int)]
        if row.granularity != "anchor" or len(columns) < len(row.shape) - 1:
            raise ConfigError(f"The dynamic set has {row.name}, which the scene lacks; take it out of the set.")
        state[row.name] = scene.anchors.positions.new_zeros(len(scene.anchors), *columns)
    return with_state(scene, state) if missing else scene


def on_device(scene: Scene, device: torch.device) -> Scene:
    """The scene with its tensors on ``device``."""
    if device.type == "cpu":
        return scene
    return with_state(scene, {name: value.to(device) for name, value in state_of(scene).items()})
