# SPDX-License-Identifier: Apache-2.0
"""In the middle of a frame: free Gaussians die and are born, in the tensors that are being fitted."""

import torch
from torch import Tensor

from structgstream.kernels.backend import Backend
from structgstream.scene.scene import Scene
from structgstream.training.optim import Adam
from structgstream.training.parameters import FREE_ROWS, Parameters, values_of_rows
from structgstream.training.patching import (
    BIRTHS_PER_FRAME,
    PatchingConfig,
    children_of,
    gaussians_by_id,
    parents_of,
    surviving,
)
from structgstream.training.statistics import GradientStatistics
from structgstream.training.views import View


def patched(
    parameters: Parameters,
    adam: Adam,
    *,
    scene: Scene,
    statistics: GradientStatistics,
    views: list[View],
    frame_index: int,
    room: int,
    config: PatchingConfig,
    backend: Backend,
    generator: torch.Generator,
) -> tuple[Tensor, int]:
    """Prunes and spawns free Gaussians, in ``parameters`` and their moments.

    Args:
        parameters: of the frame.
        adam: holds their moments.
        scene: the template of ``parameters``.
        statistics: view-space gradients by id.
        views: which pictures children may take their looks from, the first that shows a parent.
        frame_index: of the frame, for births.
        room: how many free Gaussians there may be.
        config: the rule.
        backend: what computes.
        generator: of what is random.

    Returns:
        Mask of those that survive, and how many were born.
    """
    current = parameters.scene(scene)
    keep = surviving(current.free, config)
    drawn = statistics.count.clone()
    drawn[len(drawn) - len(keep) :][~keep] = 0.0  # Those that die have no children.
    ids = parents_of(
        statistics.mean(),
        drawn,
        room=room - int(keep.sum()),
        config=config,
        generator=generator,
    )
    parents = gaussians_by_id(current, views, ids, backend)
    first_birth = frame_index * BIRTHS_PER_FRAME
    if len(parameters.births):  # Some may have been born in this frame already.
        first_birth = max(first_birth, int(parameters.births.max()) + 1)
    children = children_of(parents, first_birth=first_birth, config=config, generator=generator)
    parameters.births = torch.cat([parameters.births[keep], children.births])
    parameters.replace_rows(FREE_ROWS, keep=keep, added=values_of_rows(children, FREE_ROWS), count=len(children))
    adam.replace_rows(FREE_ROWS, keep=keep, added=len(children))
    return keep, len(children)
