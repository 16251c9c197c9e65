# SPDX-License-Identifier: Apache-2.0
"""Every frame after the first: what happens, in the order in which it happens (paper, section Methods).

Without motion selection (the paper's presets) everything is trained from its last position. With it, only dynamic
anchors and free Gaussians are, from positions that optical flow leads to.
"""

import math
from collections.abc import Mapping
from dataclasses import replace

import torch
from torch import Tensor

from structgstream.cameras import CameraRig
from structgstream.frames import MIN_CAMERAS, MultiViewFrame
from structgstream.kernels.backend import Backend
from structgstream.scene.sampling import RigSampling
from structgstream.scene.scene import Scene
from structgstream.training.online.config import OnlineConfig
from structgstream.training.online.exposure import ExposureReference, with_exposure_of
from structgstream.training.online.measure import measure
from structgstream.training.online.optimize import FrameOptimizer, StartingPoint
from structgstream.training.online.patching import IDS_PER_FRAME
from structgstream.training.online.preprocess import FramePictures, preprocess
from structgstream.training.online.scene_flow import apply_scene_flow
from structgstream.training.online.select import select_dynamic
from structgstream.training.online.spawn import prune_and_spawn
from structgstream.training.online.split import DynamicSplit
from structgstream.training.parameters import detached
from structgstream.training.residuals import BaselineResidual
from structgstream.training.result import FitResult, StepListener, Stopwatch


def fit_next_frame(
    scene: Scene,
    frame: MultiViewFrame,
    rig: CameraRig,
    *,
    config: OnlineConfig,
    backend: Backend,
    seed: int,
    pictures: FramePictures | None = None,
    steps: Mapping[str, float] | None = None,
    before_previous: Scene | None = None,
    intervals: float = 1.0,
    baseline: BaselineResidual | None = None,
    light: ExposureReference | None = None,
    on_step: StepListener | None = None,
) -> FitResult[Scene]:
    """Fit ``scene``, the decoded scene of the previous frame, to ``frame``.

    Args:
        scene: the initial scene (Note [Closed loop]).
        frame: the pictures; only those of ``rig.training`` are read, of which some may be absent.
        rig: cameras in normalised units.
        config: of online frames.
        backend: the compute back-end.
        seed: of all random numbers, so that a frame can be repeated alone.
        pictures: of ``frame``, and their changes since the previous one for motion selection (``config.motion``;
            :func:`~structgstream.training.online.preprocess.preprocess`); without them everything is trained.
        steps: quantization steps (Note [Bins]); the parameters it names are drawn and returned quantized.
        before_previous: the decoded scene two frames before, if :func:`needs_before_previous`; None for none.
        intervals: media time since the previous frame, in times of that between the two before, for the motion prior.
        baseline: residuals of frame 0, for ``config.motion.residual_threshold`` and for spawning; None for none.
        light: frame 0's, for ``config.exposure``; None for none.
        on_step: called after every iteration, or every tenth of native ones.
    """
    if pictures is None:
        pictures = preprocess(
            frame, rig, before=None, motion=config.motion, scene_flow=config.scene_flow, backend=backend
        )
    views = pictures.views
    if len(views) < min(MIN_CAMERAS, len(rig.training)):
        return held(scene)
    if config.patching.lifetime == "frame":
        scene = scene.without_free()
    scene = replace(scene, sampling=RigSampling.of(rig) if config.sampling_filter else None)
    light_counts: dict[str, int] = {}
    if config.exposure.enabled and light is not None:
        before, step = scene, (steps or {}).get("color_mlp")
        scene = with_exposure_of(before, views, light, config=config.exposure, step=step)
        light_counts = {"light changed": int(scene is not before)}

    watch, generator = Stopwatch(), torch.Generator().manual_seed(seed)
    optimizer = FrameOptimizer(config, backend, frame.index, generator, watch, steps or {}, on_step)
    prior = prior_displacements(scene, before_previous, intervals * config.motion_prior)
    if pictures.changes is None:
        result = optimizer.run(StartingPoint(scene, views, prior))
        return replace(result, counts={**result.counts, **light_counts})

    with watch.stage("select"):
        measured = measure(scene, views, pictures.changes, config=config.motion, backend=backend, baseline=baseline)
        selection = select_dynamic(
            scene, measured, config=config.motion, backend=backend, before_previous=before_previous
        )
        split = DynamicSplit.of(scene, selection)
        inliers = [views[number] for number in selection.inliers]
    with watch.stage("scene flow"):
        flow = apply_scene_flow(
            split, inliers, prior[selection.primitives], config=config.scene_flow, motion=config.motion, backend=backend
        )
    # Where flow was looked for, what is missing is too (``SceneFlowConfig.views``).
    swept = [view for view in inliers if view.index in selection.views_with_flow] or inliers
    with watch.stage("spawn"):
        spawned = prune_and_spawn(
            flow.split,
            swept,
            flow.active_tiles,
            first_identity=frame.index * IDS_PER_FRAME,
            baseline=baseline,
            room=config.patching.max_free - len(split.static.free),
            config=config.spawn,
            backend=backend,
        )
    anchors, free = flow.displacements.tensor_split([len(split.dynamic.anchors)])
    start = StartingPoint(
        replace(split.dynamic, free=split.dynamic.free.select(spawned.kept)),
        inliers,
        torch.cat([anchors, free[spawned.kept]]),
        split,
        flow.active_tiles,
        spawned.new_free,
        fast_share=flow.fast_share,
    )
    result = optimizer.run(start)
    return replace(
        result,
        scene=split.merge(result.scene),
        pruned=result.pruned + spawned.counts["pruned outliers"],
        spawned=result.spawned + len(spawned.new_free),
        counts={
            **result.counts,
            **flow.counts,
            **spawned.counts,
            "propagated": selection.occluded_count,
            **pictures.flow_counts,
            "views left out": len(views) - len(inliers),
            "scene cuts": int(selection.scene_cut),
            **light_counts,
        },
    )


def held(scene: Scene) -> FitResult[Scene]:
    """The result of a frame of which too few pictures show anything: the scene as it was."""
    return FitResult(detached(scene), iterations=0, train_psnr=math.nan, counts={"held": 1})


def needs_before_previous(config: OnlineConfig) -> bool:
    """Whether a frame depends on the two decoded frames before it, instead of one."""
    return config.motion_prior != 0.0 or (config.motion.enabled and config.motion.hysteresis != 1.0)


def prior_displacements(scene: Scene, before_previous: Scene | None, share: float) -> Tensor:
    """The motion prior ``[M + F, 3]``: ``share`` of the anchors' last displacement, and 0 for free Gaussians."""
    displacements = torch.zeros(len(scene.anchors) + len(scene.free), 3).to(scene.anchors.positions)
    if before_previous is not None and share:
        displacements[: len(scene.anchors)] = share * (scene.anchors.positions - before_previous.anchors.positions)
    return displacements
