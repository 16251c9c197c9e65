# SPDX-License-Identifier: Apache-2.0
"""Adam over named parameters whose rows come and go."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Generic, TypeVar

import torch
from torch import Tensor

from structgstream.kernels.backend import Backend

BETAS = (0.9, 0.999)
EPS = 1e-15  # As in 3D Gaussian splatting: gradients of a mean over pixels are tiny, and torch's 1e-8 would damp them.


@dataclass(frozen=True)
class LearningRate:
    """A learning-rate schedule, log-linear from ``initial`` to ``final``."""

    initial: float
    final: float

    def at(self, share: float) -> float:
        """The learning rate after ``share`` (0 to 1) of the schedule."""
        if self.initial <= 0.0 or self.final == self.initial:
            return self.initial
        share = min(max(share, 0.0), 1.0)
        return math.exp(math.log(self.initial) * (1.0 - share) + math.log(self.final) * share)


def constant(rate: float) -> LearningRate:
    """A constant learning rate."""
    return LearningRate(rate, rate)


Name = TypeVar("Name", bound=str)


def leaves(values: Mapping[Name, Tensor]) -> dict[Name, Tensor]:
    """Copies of ``values`` as leaves with gradients."""
    return {name: value.detach().clone().contiguous().requires_grad_() for name, value in values.items()}


@dataclass
class Adam(Generic[Name]):
    """Named leaf tensors and Adam's state of each; a fresh one is made for each fit, so no state crosses frames.

    Args:
        backend: computes the steps.
        values: the leaves; the mapping is shared with the caller, and updated when rows are added or removed.
        eps: Adam's epsilon.
    """

    backend: Backend
    values: dict[Name, Tensor]
    eps: float = EPS
    first: dict[Name, Tensor] = field(default_factory=dict)
    second: dict[Name, Tensor] = field(default_factory=dict)
    steps: dict[Name, int | Tensor] = field(default_factory=dict)

    def step(self, gradients: Mapping[Name, Tensor], rates: Mapping[Name, float | Tensor]) -> None:
        """Update every leaf that has a gradient and a positive learning rate; one in a tensor counts as positive."""
        for name, gradient in gradients.items():
            rate = rates[name]
            if not isinstance(rate, Tensor) and rate <= 0.0:
                continue
            value = self.values[name]
            self._begin(name)
            self.steps[name] += 1
            self.backend.adam_step(
                value.detach(),
                gradient,
                self.first[name],
                self.second[name],
                lr=rate,
                step=self.steps[name],
                betas=BETAS,
                eps=self.eps,
            )

    def count_on_device(self, names: Iterable[Name]) -> None:
        """From now on the numbers of the steps of ``names`` are tensors, so that steps can be recorded."""
        for name in names:
            self._begin(name)
            self.steps[name] = torch.full((), float(self.steps[name]), device=self.values[name].device)

    def _begin(self, name: Name) -> None:
        if name not in self.first:
            self.first[name] = torch.zeros_like(self.values[name], requires_grad=False)
            self.second[name] = torch.zeros_like(self.values[name], requires_grad=False)
            self.steps[name] = 0

    def replace_rows(self, added: Mapping[Name, Tensor], *, keep: Tensor) -> None:
        """In every leaf of ``added`` keep the rows of the mask ``keep`` and append the new rows with zero moments."""
        for name, rows in added.items():
            old = self.values[name]
            together = torch.cat([old.detach()[keep], rows.detach()])
            self.values[name] = together.contiguous().requires_grad_(old.requires_grad)
            for state in (self.first, self.second):
                if name in state:
                    kept = state[name][keep]
                    state[name] = torch.cat([kept, kept.new_zeros(rows.shape)])

    def replace_values(self, name: Name, value: Tensor) -> None:
        """Replace a leaf by ``value`` and reset its moments, but not its step count."""
        self.values[name] = value.detach().clone().contiguous().requires_grad_()
        for state in (self.first, self.second):
            if name in state:
                state[name] = torch.zeros_like(value)
