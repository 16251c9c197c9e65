# SPDX-License-Identifier: Apache-2.0
"""Every frame after the first: anchors move, free Gaussians patch (paper, section Methods).

::

    scene(t-1), decoded --> [ 50 steps ] --> prune free, spawn free --> [ 50 steps ] --> scene(t)
                              |                   ^
                              '-- view-space gradients by id
"""

from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from structgstream.cameras import CameraRig
from structgstream.frames import MultiViewFrame
from structgstream.kernels.backend import Backend
from structgstream.scene.free import FreeGaussians
from structgstream.scene.scene import Scene
from structgstream.scene.state import PAPER_DYNAMIC, FieldName
from structgstream.training.losses import LossWeights
from structgstream.training.optim import Adam
from structgstream.training.parameters import (
    FREE_ROWS,
    ParameterName,
    Parameters,
    detached,
    parameters_of_fields,
)
from structgstream.training.patching import (
    PatchingConfig,
    children_of,
    gaussians_by_id,
    parents_of,
    surviving,
)
from structgstream.training.result import FitResult, Step, StepListener
from structgstream.training.statistics import GradientStatistics
from structgstream.training.step import LastPass, gradients_of, view_loss
from structgstream.training.stopwatch import Stopwatch
from structgstream.training.views import View, shuffled_views, training_views


@dataclass(frozen=True)
class OnlineRates:
    """Learning rates of online frames (paper, section Implementations), in units of the normalised scene."""

    anchor_positions: float = 4e-4
    offset_scales: float = 5e-3
    covariance_mlp: float = 4e-3
    free_means: float = 2e-4
    free_log_scales: float = 5e-3
    free_quats: float = 1e-3
    free_logit_opacities: float = 5e-2
    free_colors: float = 2.5e-3
    base_scales: float = 5e-3
    """Used only when ``base_scales`` is in the dynamic set, as are the following."""
    anchor_offsets: float = 1e-3
    anchor_features: float = 2.5e-3
    opacity_mlp: float = 2e-3
    color_mlp: float = 4e-3
    final_share: float = 1.0
    """Rates of the anchors and MLPs fall log-linearly to this share within a frame (paper: constant)."""


@dataclass(frozen=True)
class OnlineConfig:
    """How a frame after the first is fitted."""

    iterations: int = 100
    dynamic: frozenset[FieldName] = PAPER_DYNAMIC
    """Rows of the state table that change after frame 0; the paper's ablations edit it."""
    losses: LossWeights = field(default_factory=LossWeights)
    rates: OnlineRates = field(default_factory=OnlineRates)
    patching: PatchingConfig = field(default_factory=PatchingConfig)


def online_rates(config: OnlineConfig, share: float) -> dict[ParameterName, float]:
    """Learning rate of every parameter after ``share`` (0 to 1) of a frame's iterations."""
    r = config.rates
    falling = r.final_share**share
    return {
        "anchor_positions": r.anchor_positions * falling,
        "offset_scales": r.offset_scales * falling,
        "base_scales": r.base_scales * falling,
        "anchor_offsets": r.anchor_offsets * falling,
        "anchor_features": r.anchor_features * falling,
        "opacity_mlp": r.opacity_mlp * falling,
        "color_mlp": r.color_mlp * falling,
        "covariance_mlp": r.covariance_mlp * falling,
        "free_means": r.free_means,
        "free_log_scales": r.free_log_scales,
        "free_quats": r.free_quats,
        "free_logit_opacities": r.free_logit_opacities,
        "free_colors": r.free_colors,
        "camera_gains": 0.0,
        "camera_biases": 0.0,
    }


def fit_next_frame(
    scene: Scene,
    frame: MultiViewFrame,
    rig: CameraRig,
    *,
    config: OnlineConfig,
    backend: Backend,
    seed: int,
    on_step: StepListener | None = None,
) -> FitResult:
    """Bring ``scene``, the decoded scene of the frame before, to ``frame``.

    Args:
        scene: where to start (Note [Closed loop]).
        frame: the pictures; only those of ``rig.training`` are read.
        rig: cameras in normalised units.
        config: what may change, and how.
        backend: what computes.
        seed: all randomness comes from it, so a frame can be repeated alone.
        on_step: called after every iteration.
    """
    generator = torch.Generator().manual_seed(seed)
    watch = Stopwatch(backend.device)
    patching = config.patching
    if patching.lifetime == "frame":
        scene = scene.without_free()
    views = training_views(frame, rig, backend.device)
    order = shuffled_views(views, generator)
    parameters = Parameters.of(scene, trained=parameters_of_fields(config.dynamic))
    adam = Adam(backend)
    statistics = GradientStatistics(_slots(scene), backend.device)
    last_pass = LastPass()
    spawned = pruned = 0
    for iteration in range(1, config.iterations + 1):
        view = next(order)
        current = parameters.scene(scene)
        loss = view_loss(
            current,
            view,
            backend=backend,
            weights=config.losses,
            voxel_size=0.0,
            track_screen=patching.spawn != "off" and patching.collect_from < iteration <= patching.iteration,
            watch=watch,
        )
        gradients, screen_gradient = gradients_of(loss, parameters, watch)
        if iteration > config.iterations - len(views):
            last_pass.add(loss, view)
        with watch.stage("optimise"):
            adam.step(parameters, gradients, online_rates(config, (iteration - 1) / config.iterations))
        if screen_gradient is not None:
            statistics.add(loss.rendering, screen_gradient)
        if iteration == patching.iteration and "free" in config.dynamic:
            with watch.stage("patch"), torch.no_grad():
                spawned, pruned = _patch(
                    parameters,
                    adam,
                    scene=scene,
                    statistics=statistics,
                    views=[view, *(other for other in views if other.index != view.index)],
                    frame_index=frame.index,
                    config=patching,
                    backend=backend,
                    generator=generator,
                )
        if on_step is not None:
            free = parameters.values["free_means"].shape[0]
            on_step(Step(iteration, config.iterations, float(loss.total.detach()), len(scene.anchors), free))
    return FitResult(
        scene=detached(parameters.scene(scene)),
        iterations=config.iterations,
        train_psnr=last_pass.psnr,
        spawned=spawned,
        pruned=pruned,
        seconds=watch.seconds,
        losses=last_pass.terms,
    )


def _slots(scene: Scene) -> int:
    """Number of ids in a scene (Note [Ids])."""
    return len(scene.anchors) * scene.anchors.offsets_per_anchor + len(scene.free)


def _patch(
    parameters: Parameters,
    adam: Adam,
    *,
    scene: Scene,
    statistics: GradientStatistics,
    views: list[View],
    frame_index: int,
    config: PatchingConfig,
    backend: Backend,
    generator: torch.Generator,
) -> tuple[int, int]:
    """Prune and spawn free Gaussians; returns how many were added and removed."""
    current = parameters.scene(scene)
    keep = surviving(current.free, config)
    ids = parents_of(
        statistics.mean(),
        statistics.count,
        room=config.max_free - int(keep.sum()),
        config=config,
        generator=generator,
    )
    parents = gaussians_by_id(current, views, ids, backend)
    children = children_of(parents, frame_index=frame_index, config=config, generator=generator)
    added = _free_rows(children)
    parameters.births = torch.cat([parameters.births[keep], children.births])
    parameters.replace_rows(FREE_ROWS, keep=keep, added=added)
    adam.replace_rows(FREE_ROWS, keep=keep, added=len(children))
    return len(children), int((~keep).sum())


def _free_rows(free: FreeGaussians) -> dict[ParameterName, Tensor]:
    return {
        "free_means": free.means,
        "free_log_scales": free.log_scales,
        "free_quats": free.quats,
        "free_logit_opacities": free.logit_opacities,
        "free_colors": free.colors,
    }


def without_patching(config: OnlineConfig) -> OnlineConfig:
    """The same configuration with no free Gaussians: the paper's baseline of its free-3DG ablation."""
    return replace(config, patching=replace(config.patching, spawn="off"))
