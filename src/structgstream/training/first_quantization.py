# SPDX-License-Identifier: Apache-2.0
"""Frame 0 as whole numbers of steps, which the init record codes: as few bits as the pictures allow.

Note [Sensitivity]
~~~~~~~~~~~~~~~~~~
What an error of a number does to the pictures is, to first order, the square of their derivative by it. One backward
pass of a picture weighted with random signs has the sum of these squares over all pixels as the expectation of its
squared gradients (Hutchinson, 1989), so a pass over the cameras tells what every number is worth. Steps follow from
it: each number may add the same error.

Note [Gauges]
~~~~~~~~~~~~~
Many scenes draw the same pictures. Features may be mapped by any invertible matrix if the MLPs' first layers undo it;
of these the one is taken in which every direction is worth the same and directions do not depend on each other
(Karhunen-Loeve), so most columns of most anchors become zero. l_v only multiplies O_v, and both are fitted: l_v
becomes 1, and the offsets lengths in the scene. What a position loses on its grid its offsets get.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from structgstream.cameras import CameraRig
from structgstream.kernels.anchor_types import HeadWeights, MLPWeights
from structgstream.kernels.backend import Backend
from structgstream.scene.render import draw
from structgstream.scene.scene import Scene
from structgstream.scene.state import FIELDS, STATE_TABLE, FieldName, scene_of, state_of
from structgstream.training.rounding import RoundingConfig, round_straight_through

SENSITIVITY_FIELDS: tuple[FieldName, ...] = tuple(row.name for row in STATE_TABLE if row.init_step == "sensitivity")
FINEST, COARSEST = -1, 2
"""Of an anchor's step, as powers of two times that of an average one: what is hidden now may come to light."""
_LEAST_SHARE = 1e-4  # of the largest eigenvalue: directions of features are not stretched further than by 100


@dataclass(frozen=True)
class Sensitivity:
    """How pictures depend on a scene: means over all their numbers, in units of full scale (Note [Sensitivity]).

    Args:
        fields: squared derivatives by each number of the :data:`SENSITIVITY_FIELDS` fields, of their shapes.
        features: ``[D, D]``, products of the derivatives by an anchor's features, summed over anchors.
        used: ``[M, K]``, the offsets whose opacity is above zero for some camera.
    """

    fields: Mapping[FieldName, Tensor]
    features: Tensor
    used: Tensor


def estimate_sensitivity(scene: Scene, rig: CameraRig, *, backend: Backend, seed: int) -> Sensitivity:
    """What the training cameras of ``rig`` (in the scene's units) see of every number."""
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
        open_scene = scene_of(state, distance_input=scene.distance_input)
        structured = open_scene.structured(rig[name], backend)
        used[structured.anchors] |= structured.raw_opacities > 0
        behind = open_scene.background(rig[name])
        image = draw(open_scene.with_free_gaussians(structured), rig[name], backend, background=behind).image
        count += image.numel()
        if not image.requires_grad:  # It shows nothing.
            continue
        signs = (torch.randint(0, 2, image.shape, generator=generator) * 2 - 1).to(image)
        found = torch.autograd.grad(
            (image * signs).sum(), [state[field] for field in SENSITIVITY_FIELDS], allow_unused=True
        )
        for field, gradient in zip(SENSITIVITY_FIELDS, found, strict=True):
            if gradient is not None:
                squares[field] += gradient.square()
                if field == "anchor_features":
                    products += gradient.double().T @ gradient.double()
    for value in (*squares.values(), products):
        value /= max(count, 1)
    return Sensitivity(squares, products, used)


def regauge(scene: Scene, sensitivity: Sensitivity) -> tuple[Scene, Sensitivity]:
    """A scene that draws the same with numbers that cost less (Note [Gauges]), and what they are worth."""
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
    """A matrix ``[D, D]`` that makes directions worth the same and independent, the most varied first; its inverse."""
    values, vectors = torch.linalg.eigh(products)
    if not len(features) or not float(values.max()) > 0.0:
        same = torch.eye(len(products)).to(products)
        return same, same
    stretched = vectors * values.clamp(min=_LEAST_SHARE * float(values.max())).sqrt()
    centred = features.double() - features.double().mean(0)
    turn = torch.linalg.eigh((centred @ stretched).T @ (centred @ stretched)).eigenvectors.flip(1)
    forward = stretched @ turn
    inverse = torch.linalg.inv(forward)
    # The scale is free: weights stay as large as they are, for steps and rates that are used to it.
    seen = torch.cat([head.w1[:, : len(products)] for head in mlps]).double()
    scale = ((seen @ inverse.T).square().sum() / seen.square().sum().clamp(min=1e-300)).sqrt().clamp(min=1e-30)
    return forward * scale, inverse / scale


def _fold_into_mlp(head: HeadWeights, mean: Tensor, inverse: Tensor) -> HeadWeights:
    """The MLP for features less ``mean``, times the inverse of ``inverse``."""
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
    """The scene with all that the init record codes as whole numbers of steps, and these steps by field.

    Args:
        scene: frame 0, as :func:`regauge` gave it.
        sensitivity: of ``scene``.
        config: how much may be lost.
        voxel_size: the grid of the anchors.
        steps: of what changes later: what the frames after this one round to.
    """
    plain, state = config.resolved(), state_of(scene)
    used = sensitivity.used[..., None].expand_as(state["anchor_offsets"])
    counted = {"anchor_offsets": used}
    numbers = sum(
        int((sensitivities > 0).logical_and(counted.get(name, sensitivities > 0)).sum())
        for name, sensitivities in sensitivity.fields.items()
    )
    # A step has the error of its square over twelve; all numbers have the same.
    most = plain.first_noise_levels / 255.0 * (12.0 / max(numbers, 1)) ** 0.5
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
            step = getattr(plain, key) if row.init_step else steps.get(name, getattr(plain, key))
            found[name] = float32(step)
            state[name] = round_straight_through(state[name], found[name])
    return scene_of(state, distance_input=scene.distance_input), found


def _quantize_rows(
    values: Tensor, sensitivities: Tensor, most: float, *, counted: Tensor | None
) -> tuple[float, Tensor]:
    """A step, and values ``[M, ...]`` as multiples of it times a power of two for each row."""
    counted = sensitivities > 0 if counted is None else counted
    flat, rows = sensitivities * counted, tuple(range(1, sensitivities.dim()))
    mean = float(flat.sum() / counted.sum().clamp(min=1))
    if not mean > 0.0:
        mean = 1.0
    of_row = flat.sum(rows) / counted.sum(rows).clamp(min=1)
    powers = (0.5 * (mean / of_row.clamp(min=1e-30)).log2()).round().clamp(FINEST, COARSEST)
    step = float32(most / mean**0.5 * 2.0**FINEST)
    sizes = step * torch.exp2(powers - FINEST).reshape(-1, *[1] * len(rows))
    return step, (values / sizes).round() * sizes


def float32(value: float) -> float:
    """The nearest float32 number."""
    return float(torch.tensor(value, dtype=torch.float32))
