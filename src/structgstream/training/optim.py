# SPDX-License-Identifier: Apache-2.0
"""Adam over named parameters whose rows come and go."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import torch
from torch import Tensor

from structgstream.kernels.backend import Backend
from structgstream.scene.state import ParameterName
from structgstream.training.parameters import Parameters

BETAS = (0.9, 0.999)
EPS = 1e-15  # As 3D Gaussian splatting: gradients of a mean over pixels are tiny, torch's 1e-8 would damp them.


@dataclass(frozen=True)
class Rate:
    """A learning rate, log-linear from ``initial`` to ``final`` over a schedule."""

    initial: float
    final: float

    def at(self, share: float) -> float:
        """The rate after ``share`` (0 to 1) of the schedule."""
        if self.initial <= 0.0 or self.final == self.initial:
            return self.initial
        share = min(max(share, 0.0), 1.0)
        return math.exp(math.log(self.initial) * (1.0 - share) + math.log(self.final) * share)


def constant(rate: float) -> Rate:
    """A rate that does not change."""
    return Rate(rate, rate)


@dataclass
class Adam:
    """Adam state by parameter name; a fresh one is made for each frame, so no state crosses frames."""

    backend: Backend
    first: dict[ParameterName, Tensor] = field(default_factory=dict)
    second: dict[ParameterName, Tensor] = field(default_factory=dict)
    steps: dict[ParameterName, int] = field(default_factory=dict)

    def step(
        self,
        parameters: Parameters,
        gradients: Mapping[ParameterName, Tensor],
        rates: Mapping[ParameterName, float],
    ) -> None:
        """Move every parameter that has a gradient and a positive rate."""
        for name, gradient in gradients.items():
            rate = rates[name]
            if rate <= 0.0:
                continue
            value = parameters.values[name]
            if name not in self.first:
                self.first[name] = torch.zeros_like(value, requires_grad=False)
                self.second[name] = torch.zeros_like(value, requires_grad=False)
                self.steps[name] = 0
            self.steps[name] += 1
            self.backend.adam_step(
                value.detach(),
                gradient,
                self.first[name],
                self.second[name],
                lr=rate,
                step=self.steps[name],
                betas=BETAS,
                eps=EPS,
            )

    def replace_rows(self, names: Iterable[ParameterName], *, keep: Tensor, added: int) -> None:
        """Drop the state of rows not in the mask ``keep`` and append ``added`` rows of zeros."""
        for name in names:
            for state in (self.first, self.second):
                if name in state:
                    old = state[name]
                    state[name] = torch.cat([old[keep], old.new_zeros(added, *old.shape[1:])])
