# SPDX-License-Identifier: Apache-2.0
"""Pruning and spawning of free Gaussians during a frame's optimisation."""

from dataclasses import dataclass

import torch
from torch import Tensor

from structgstream.kernels.backend import Backend
from structgstream.scene.scene import Scene
from structgstream.scene.state import ParameterName
from structgstream.training.optim import Adam
from structgstream.training.parameters import FREE_ROWS, Parameters, values_of_rows
from structgstream.training.patching import (
    BIRTHS_PER_FRAME,
    PatchingConfig,
    choose_parents,
    gaussians_by_id,
    spawn_children,
    survivor_mask,
)
from structgstream.training.statistics import GradientStatistics
from structgstream.training.views import View


@dataclass
class Population:
    """The free Gaussians of one frame's fit, which it prunes and spawns.

    Args:
        config: the rule.
        template: of ``parameters``.
        parameters: of the frame.
        adam: of their values.
        statistics: view-space gradients by id.
        views: from which children may copy colour and scale.
        frame_index: of the frame, for births.
        room: largest number of free Gaussians.
        backend: the compute back-end.
        generator: of random numbers.
        spawned: number of spawned ones so far.
        pruned: number of pruned ones so far.
        version: how often rows came or went; between, the tensors stay where they are.
    """

    config: PatchingConfig
    template: Scene
    parameters: Parameters
    adam: Adam[ParameterName]
    statistics: GradientStatistics
    views: list[View]
    frame_index: int
    room: int
    backend: Backend
    generator: torch.Generator
    spawned: int = 0
    pruned: int = 0
    version: int = 0

    def __len__(self) -> int:
        return len(self.parameters.births)

    def patch(self, view: View) -> Tensor:
        """Prunes and spawns; returns the mask of the survivors.

        A child copies its parent's appearance in ``view``, if that draws it, else in the first other view that does.
        """
        current = self.parameters.scene(self.template)
        keep = survivor_mask(current.free, self.config)
        others = [other for other in self.views if other.index != view.index]
        parents = gaussians_by_id(current, [view, *others], self._parents(keep), self.backend)
        children = spawn_children(parents, first_birth=self._next_birth(), config=self.config, generator=self.generator)
        if keep.all() and not len(children):
            return keep
        self.version += 1
        self.parameters.births = torch.cat([self.parameters.births[keep], children.births])
        self.adam.replace_rows(values_of_rows(children, FREE_ROWS), keep=keep)
        self.spawned, self.pruned = self.spawned + len(children), self.pruned + int((~keep).sum())
        return keep

    def _parents(self, keep: Tensor) -> Tensor:
        """Ids ``[P]`` that get a child when only those of the mask ``keep`` survive."""
        drawn = self.statistics.count.clone()
        drawn[len(drawn) - len(keep) :][~keep] = 0.0  # Pruned ones have no children.
        return choose_parents(
            self.statistics.mean(),
            drawn,
            room=self.room - int(keep.sum()),
            config=self.config,
            generator=self.generator,
        )

    def _next_birth(self) -> int:
        first = self.frame_index * BIRTHS_PER_FRAME
        births = self.parameters.births
        # Some may have been born in this frame already.
        return max(first, int(births.max()) + 1) if len(births) else first
