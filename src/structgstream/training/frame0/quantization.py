# SPDX-License-Identifier: Apache-2.0
"""Quantization of frame 0 for the init record, with steps from the sensitivity of the rendered pictures.

Note [Sensitivity]
~~~~~~~~~~~~~~~~~~
To first order, the squared error of the pictures caused by an error of a value is proportional to the sum over pixels
of the squared derivatives by that value. The squared gradient of a picture weighted with random signs is an unbiased
estimate of this sum (Hutchinson, 1989), so one backward pass per training camera estimates the sensitivity to every
value. Steps are chosen so that each value adds the same error.

Note [Gauges]
~~~~~~~~~~~~~
The parametrisation of a scene is not unique. Features may be mapped by any invertible matrix if the MLPs' first layers
apply its inverse; we take the one for which the sensitivity is equal in all directions and the features are
uncorrelated (Karhunen-Loeve), so that most columns of most anchors become zero. l_v only multiplies O_v: l_v is set to
1, and the offsets become lengths in the scene. The quantization error of a position is added to its offsets.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from structgstream.cameras import CameraRig
from structgstream.codec.fields.quantization import float32, round_straight_through
from structgstream.kernels.backend import Backend
from structgstream.kernels.values import HeadWeights, MLPWeights
from structgstream.scene.render import draw
from structgstream.scene.scene import Scene
from structgstream.scene.state import FIELDS, STATE_TABLE, FieldName, state_of, with_state
from structgstream.training.parameters import RoundingConfig

SENSITIVITY_FIELDS: tuple[FieldName, ...] = tuple(row.name for row in STATE_TABLE if row.init_step == "sensitivity")
FINEST, COARSEST = -1, 2
"""Bounds of an anchor's step relative to the mean one, as powers of two: occluded anchors may become visible later."""
_MIN_SHARE = 1e-4  # of the largest eigenvalue: features are not scaled by more than 100


@dataclass(frozen=True)
class Sensitivity:
    """Sensitivity of the pictures to a scene, as means over all pixels and channels, full scale 1 (Note [Sensitivity]).

    Args:
        fields: squared derivatives by each value of the :data:`SENSITIVITY_FIELDS` fields, of their shapes.
        features: ``[D, D]``, products of the derivatives by an anchor's features, summed over anchors.
        used: ``[M, K]``, mask of the offsets whose opacity is above zero for some camera.
    """

    fields: Mapping[FieldName, Tensor]
    features: Tensor
    used: Tensor


def estimate_sensitivity(scene: Scene, rig: CameraRig, *, backend: Backend, seed: int) -> Sensitivity:
    """Sensitivity of the pictures of ``rig``'s training cameras (in the scene's units)."""
    generator = torch.Generator().manual_seed(seed)
    state: dict[FieldName, Tensor] = {name: value.detach() for name, value in state_of(scene).items()}
    for name in SENSITIVITY_FIELDS:
        state[name] = state[name].clone().requires_grad_()
    squares: dict[FieldName, Tensor] = {
        name: torch.zeros_like(state[name], requires_grad=False) for name in SENSITIVITY_FIELDS
    }
    features = state["anchor_features"].shape[1]
    products = torch.zeros(features, features, dtype=torch.float64, device=scene.anchors.positions.device)
    used = torch.zeros(state["anchor_offsets"].shape[:2], dtype=torch.bool, device=products.device)
    count = 0
    for name in rig.training:
        open_scene = with_state(scene, state)
        structured = open_scene.structured(rig[name], backend)
        used[structured.anchors] |= structured.raw_opacities > 0
        behind = open_scene.background(rig[name])
        image = draw(open_scene.with_free_gaussians(structured), rig[name], backend, background=behind).image
        count += image.numel()
        if not image.requires_grad:  # Nothing is drawn.
            continue
        signs = (torch.randint(0, 2, image.shape, generator=generator) * 2 - 1).to(image)
        leaves = [state[field] for field in SENSITIVITY_FIELDS]
        found = torch.autograd.grad((image * signs).sum(), leaves, allow_unused=True)
        for field, gradient in zip(SENSITIVITY_FIELDS, found, strict=True):
            if gradient is not None:
                squares[field] += gradient.square()
                if field == "anchor_features":
                    products += gradient.double().T @ gradient.double()
    for value in (*squares.values(), products):
        value /= max(count, 1)
    return Sensitivity(squares, products, used)


def whiten_features(scene: Scene, sensitivity: Sensitivity) -> tuple[Scene, Sensitivity]:
    """An equivalent scene whose values cost fewer bits (Note [Gauges]), and its sensitivity."""
    anchors, fields = scene.anchors, dict(sensitivity.fields)
    lengths = anchors.log_offset_scales.exp()[:, None]
    fields["anchor_offsets"] = fields["anchor_offsets"] / lengths.square()
    forward, inverse = _whitening_matrices(anchors.features, sensitivity.features, scene.mlps)
    features = anchors.features.double()
    mean = features.mean(0) if len(features) else features.new_zeros(features.shape[1])
    products = inverse @ sensitivity.features @ inverse.T
    # Of an anchor's directions together as before, of all anchors together as now.
    scaling = products.diagonal().sum() / sensitivity.features.diagonal().sum().clamp(min=1e-300)
    fields["anchor_features"] = fields["anchor_features"] * scaling.to(fields["anchor_features"])
    return replace(
        scene,
        anchors=replace(
            anchors,
            features=((features - mean) @ forward).to(anchors.features).contiguous(),
            offsets=torch.where(sensitivity.used[..., None], anchors.offsets * lengths, 0.0),
            log_offset_scales=torch.zeros_like(anchors.log_offset_scales),
        ),
        mlps=MLPWeights(*(_fold_into_mlp(head, mean, inverse) for head in scene.mlps)),
    ), Sensitivity(fields, products, sensitivity.used)


def _whitening_matrices(features: Tensor, products: Tensor, mlps: MLPWeights) -> tuple[Tensor, Tensor]:
    """Matrix ``[D, D]`` to uncorrelated features of equal sensitivity, by decreasing variance, and its inverse."""
    values, vectors = torch.linalg.eigh(products)
    if not len(features) or not float(values.max()) > 0.0:
        same = torch.eye(len(products)).to(products)
        return same, same
    stretched = vectors * values.clamp(min=_MIN_SHARE * float(values.max())).sqrt()
    centred = features.double() - features.double().mean(0)
    turn = torch.linalg.eigh((centred @ stretched).T @ (centred @ stretched)).eigenvectors.flip(1)
    forward = stretched @ turn
    inverse = torch.linalg.inv(forward)
    # The scale is free: it keeps the magnitude of the weights, for which steps and learning rates are tuned.
    seen = torch.cat([head.w1[:, : len(products)] for head in mlps]).double()
    scale = ((seen @ inverse.T).square().sum() / seen.square().sum().clamp(min=1e-300)).sqrt().clamp(min=1e-30)
    return forward * scale, inverse / scale


def _fold_into_mlp(head: HeadWeights, mean: Tensor, inverse: Tensor) -> HeadWeights:
    """The MLP whose first layer undoes the change of features: minus ``mean``, times the inverse of ``inverse``."""
    seen, rest = head.w1[:, : len(mean)].double(), head.w1[:, len(mean) :]
    w1 = torch.cat([(seen @ inverse.T).to(rest), rest], dim=1)
    return head._replace(w1=w1, b1=(head.b1.double() + seen @ mean).to(head.b1))


def quantize_first_frame(
    scene: Scene,
    sensitivity: Sensitivity,
    *,
    config: RoundingConfig,
    voxel_size: float,
    steps: Mapping[str, float],
) -> tuple[Scene, dict[FieldName, float]]:
    """Quantizes the fields that the init record codes; returns the dequantized scene and the steps by field.

    Args:
        scene: frame 0, as :func:`whiten_features` returned it.
        sensitivity: of ``scene``.
        config: allowed error and fixed steps.
        voxel_size: the grid of the anchors.
        steps: quantization steps of the later frames, for dynamic fields.
    """
    state = state_of(scene)
    used = sensitivity.used[..., None].expand_as(state["anchor_offsets"])
    counted = {"anchor_offsets": used}
    numbers = sum(
        int((sensitivities > 0).logical_and(counted.get(name, sensitivities > 0)).sum())
        for name, sensitivities in sensitivity.fields.items()
    )
    # A quantization error has the variance step^2 / 12; all values contribute equally.
    most = config.at_quality("first_noise_levels") / 255.0 * (12.0 / max(numbers, 1)) ** 0.5
    found: dict[FieldName, float] = {"anchor_positions": float32(voxel_size)}
    state["anchor_positions"] = round_straight_through(state["anchor_positions"], found["anchor_positions"])
    shown = state["anchor_positions"]
    if "anchor_positions" in steps:
        shown = round_straight_through(shown, steps["anchor_positions"])
    lost = (scene.anchors.positions - shown) / scene.anchors.log_offset_scales.exp()
    state["anchor_offsets"] = torch.where(used, state["anchor_offsets"] + lost[:, None], 0.0)
    for name, sensitivities in sensitivity.fields.items():
        found[name], state[name] = _quantize_rows(state[name], sensitivities, most, counted=counted.get(name))
    if scene.appearance_basis is not None:
        shortest = float(scene.appearance_basis.norm(dim=1).min())
        found["appearance_basis"] = float32(max(shortest / 64, 1e-9))
        state["appearance_basis"] = round_straight_through(state["appearance_basis"], found["appearance_basis"])
    for name in state.keys() - found.keys():
        row = FIELDS[name]
        if row.init_coding != "uncoded" and (key := row.init_step or row.step) not in (None, "own"):
            step = config.at_quality(key) if row.init_step else steps.get(name, config.at_quality(key))
            found[name] = float32(step)
            state[name] = round_straight_through(state[name], found[name])
    return with_state(scene, state), found


def _quantize_rows(
    values: Tensor, sensitivities: Tensor, most: float, *, counted: Tensor | None
) -> tuple[float, Tensor]:
    """A step, and values ``[M, ...]`` quantized to it times a power of two per row."""
    counted = sensitivities > 0 if counted is None else counted
    flat, rows = sensitivities * counted, tuple(range(1, sensitivities.dim()))
    # In float64: the last bits of a float32 sum depend on the number of threads, and all later frames on the step.
    mean = float(flat.sum(dtype=torch.float64) / counted.sum().clamp(min=1))
    if not mean > 0.0:
        mean = 1.0
    of_row = flat.sum(rows) / counted.sum(rows).clamp(min=1)
    powers = (0.5 * (mean / of_row.clamp(min=1e-30)).log2()).round().clamp(FINEST, COARSEST)
    step = float32(most / mean**0.5 * 2.0**FINEST)
    sizes = step * torch.exp2(powers - FINEST).reshape(-1, *[1] * len(rows))
    return step, (values / sizes).round() * sizes
