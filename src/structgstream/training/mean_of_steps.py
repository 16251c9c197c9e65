# SPDX-License-Identifier: Apache-2.0
"""The mean of a fit's last iterations (Polyak and Juditsky, 1992): it has less of the noise of single views."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import torch
from torch import Tensor

from structgstream.scene.state import ParameterName


@dataclass
class MeanOfSteps:
    """Sums of trained leaves over the iterations after ``after``.

    A leaf whose number of rows changes, because free Gaussians are pruned or born, starts again.
    """

    after: int
    sums: dict[ParameterName, Tensor] = field(default_factory=dict)
    counts: dict[ParameterName, int] = field(default_factory=dict)

    def add(self, iteration: int, values: Mapping[ParameterName, Tensor]) -> None:
        """Add the leaves after ``iteration``, counted from 1."""
        if iteration <= self.after:
            return
        for name, value in values.items():
            if not value.requires_grad:
                continue
            if name in self.sums and self.sums[name].shape == value.shape:
                self.sums[name] += value.detach()
                self.counts[name] += 1
            else:
                self.sums[name], self.counts[name] = value.detach().clone(), 1

    def apply(self, values: Mapping[ParameterName, Tensor]) -> None:
        """Set the leaves to their means, in place."""
        with torch.no_grad():
            for name, total in self.sums.items():
                if total.shape == values[name].shape:
                    values[name].copy_(total / self.counts[name])
