# SPDX-License-Identifier: Apache-2.0
"""How a stream begins: where frame 0 starts from, and what the frames after it and every receiver need of it."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import torch

from structgstream.codec.packets import StreamHeader
from structgstream.codec.scene.bins import on_bins
from structgstream.data.points import PointsConfig, initial_points
from structgstream.data.source import FrameSource
from structgstream.frames import MultiViewFrame
from structgstream.kernels.backend import Backend
from structgstream.presets import StreamConfig, to_json
from structgstream.scene.appearance import with_appearance
from structgstream.scene.order import in_space_order
from structgstream.scene.scene import Scene
from structgstream.scene.state import FieldName, fields_of, parameters_of, scene_of, state_of, with_dynamic_fields
from structgstream.similarity import Similarity
from structgstream.training.environment import fitted_environment
from structgstream.training.first_bins import Sensitivity, first_bins, float32, regauged, sensitivity_of
from structgstream.training.rounding import pixel_size
from structgstream.training.views import training_views


def frame_seed(seed: int, index: int) -> int:
    """A seed of its own for each frame, so that a frame can be repeated alone."""
    return (seed * 1_000_003 + index) % 2**63


def initial_points_of(
    source: FrameSource, frame: MultiViewFrame, *, config: PointsConfig, seed: int, similarity: Similarity
) -> torch.Tensor:
    """Points ``[P, 3]`` of the capture or made from ``frame``, normalised, after a look at the poses."""
    from structgstream.data.pose_check import check_poses

    check_poses(frame, source.rig)
    given = source.points
    if given is None:
        given = initial_points(frame, source.rig, config=config, seed=seed).positions
    return similarity.points(torch.from_numpy(given))


def begun(
    scene: Scene,
    source: FrameSource,
    *,
    frame: MultiViewFrame,
    config: StreamConfig,
    metadata: Mapping[str, object],
    similarity: Similarity,
    backend: Backend,
) -> tuple[Scene, StreamHeader]:
    """Frame 0 as the frames after it start from it, and the header of the stream.

    With codec ``compact`` every number of the header is a bin, so the scene is the fitted one, rounded and in space
    order.

    Args:
        scene: as it was fitted.
        source: the capture.
        frame: its first pictures; only those of training cameras are read.
        config: of the stream.
        metadata: plain JSON values for the header.
        similarity: from the capture's units to the scene's.
        backend: what computes.
    """
    dynamic, rounding = config.online.dynamic, config.online.rounding
    rig = similarity.rig(source.rig)
    if config.environment.enabled:
        views = training_views(frame, rig, backend.device)
        found = fitted_environment(scene, views, config=config.environment, backend=backend)
        scene = replace(scene, environment=found)
    worth: Sensitivity | None = None
    if config.codec == "compact":
        worth = sensitivity_of(scene, rig, backend=backend, seed=frame_seed(config.seed, 0))
        scene, worth = regauged(scene, worth)
    if "appearance" in dynamic:
        scene = with_appearance(scene, config.online.appearance_rank)
    scene = with_dynamic_fields(scene, dynamic)
    steps: dict[str, float] = {}
    init_steps: dict[FieldName, float] = {}
    if worth is not None:
        known = rounding.steps(pixel_size(scene.anchors.positions, rig))
        used = {parameter.name for parameter in parameters_of(dynamic)}
        steps = {name: float(np.float32(step)) for name, step in known.items() if name in used}
        voxel_size = config.initial.voxel_size
        scene, init_steps = first_bins(scene, worth, config=rounding, voxel_size=voxel_size, steps=steps)
        if scene.environment is not None:
            init_steps["environment"] = float32(config.environment.step)
        rounded = on_bins(state_of(in_space_order(scene, step=init_steps["anchor_positions"])), init_steps)
        scene = scene_of(rounded, distance_input=scene.distance_input)
    state = state_of(scene)
    reference = dynamic.difference(fields_of("free")) if steps else ()
    header = StreamHeader(
        rig=source.rig,
        similarity=similarity,
        fps=source.fps,
        codec=config.codec,
        dynamic=dynamic,
        static={name: value.cpu() for name, value in state.items() if name not in dynamic},
        distance_input=scene.distance_input,
        config=to_json(config),
        metadata=metadata,
        steps=steps,
        reference={name: state[name].cpu() for name in reference},
        init_steps=init_steps,
    )
    return scene, header
