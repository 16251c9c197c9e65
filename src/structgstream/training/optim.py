# SPDX-License-Identifier: Apache-2.0
"""Adam, the optimisation loop of all fits (a view, its loss, one Adam step), and what follows its steps.

Fits differ in their hooks: the loss of a view, and the actions between steps (growing, patching).
``training/frame0/fit.py``, ``training/online/iterations.py`` and the methods of studies use this loop.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Generic, TypeVar

import torch
from torch import Tensor

from structgstream.gaussians import row_indices
from structgstream.kernels.backend import Backend
from structgstream.scene.state import ParameterName
from structgstream.training.losses import Loss, ViewLoss
from structgstream.training.result import Step, StepListener, Stopwatch
from structgstream.training.views import View

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
    steps: dict[Name, int] = field(default_factory=dict)

    def step(self, gradients: Mapping[Name, Tensor], rates: Mapping[Name, float]) -> None:
        """Update every leaf that has a gradient and a positive learning rate."""
        for name, gradient in gradients.items():
            if rates[name] <= 0.0:
                continue
            value = self.values[name]
            self.begin(name)
            self.steps[name] += 1
            self.backend.adam_step(
                value.detach(),
                gradient,
                self.first[name],
                self.second[name],
                lr=rates[name],
                step=self.steps[name],
                betas=BETAS,
                eps=self.eps,
            )

    def begin(self, name: Name) -> None:
        """Set the moments of a leaf that was never updated to zero."""
        if name not in self.first:
            self.first[name] = torch.zeros_like(self.values[name], requires_grad=False)
            self.second[name] = torch.zeros_like(self.values[name], requires_grad=False)
            self.steps[name] = 0

    def replace_rows(self, added: Mapping[Name, Tensor], *, keep: Tensor) -> None:
        """In every leaf of ``added`` keep the rows of the mask ``keep`` and append the new rows with zero moments."""
        kept_rows = row_indices(keep, next(iter(added.values())))
        for name, rows in added.items():
            old = self.values[name]
            together = torch.cat([old.detach()[kept_rows], rows.detach()])
            self.values[name] = together.contiguous().requires_grad_(old.requires_grad)
            for state in (self.first, self.second):
                if name in state:
                    kept = state[name][kept_rows]
                    state[name] = torch.cat([kept, kept.new_zeros(rows.shape)])


SampleT = TypeVar("SampleT")
LossT = TypeVar("LossT", bound=Loss)


@dataclass(frozen=True)
class Schedule(Generic[Name]):
    """Number of iterations and learning rates.

    Args:
        iterations: largest number of steps.
        rates: gives the learning rate of every leaf in an iteration, counted from 1.
        before: steps of the frame in stages before this one, for progress.
        after: steps of the frame in stages after this one, for progress.
        done: iterations that count as done: the first one is the one after them.
    """

    iterations: int
    rates: Callable[[int], Mapping[Name, float]]
    before: int = 0
    after: int = 0
    done: int = 0


class Hooks(ABC, Generic[SampleT, LossT]):
    """The parts of an iteration, counted from 1, in which fits differ."""

    @abstractmethod
    def loss(self, iteration: int, sample: SampleT) -> LossT:
        """The loss of a sample, which usually is a view of the frame; what else there is to do belongs in
        :meth:`after_step`."""

    def after_step(self, iteration: int, sample: SampleT, loss: LossT, screen_gradient: Tensor | None) -> None:
        """Called after the step: statistics, spawning, pruning.

        ``screen_gradient`` ``[N, 2]`` is the view-space gradient in pixels; None if it was not tracked.
        """

    def counts(self) -> tuple[int, int]:
        """Anchors and free Gaussians, for progress."""
        return 0, 0


def minimize(
    adam: Adam[Name],
    samples: Iterator[SampleT],
    schedule: Schedule[Name],
    hooks: Hooks[SampleT, LossT],
    *,
    watch: Stopwatch,
    on_step: StepListener | None = None,
) -> int:
    """Minimise the losses of ``samples`` over the leaves of ``adam``; returns the number of iterations done.

    Args:
        adam: with the leaves.
        samples: an endless iterator; one sample per iteration.
        schedule: number of iterations and learning rates.
        hooks: the loss, and the actions between steps.
        watch: gets the seconds of stages ``backward`` and ``optimise``.
        on_step: called after every iteration; on a GPU, where reading the loss synchronises, after every tenth.
    """
    report_interval = 1 if adam.backend.device.type == "cpu" else 10
    total = schedule.before + schedule.iterations + schedule.after
    iteration = schedule.done
    while iteration < schedule.iterations:
        iteration += 1
        sample = next(samples)
        loss, screen_gradient = _take_step(adam, hooks, iteration, sample, schedule.rates(iteration), watch)
        hooks.after_step(iteration, sample, loss, screen_gradient)
        if on_step is not None and iteration % report_interval == 0:
            on_step(Step(schedule.before + iteration, total, float(loss.total.detach()), *hooks.counts()))
    return iteration - schedule.done


def _take_step(
    adam: Adam[Name],
    hooks: Hooks[SampleT, LossT],
    iteration: int,
    sample: SampleT,
    rates: Mapping[Name, float],
    watch: Stopwatch,
) -> tuple[LossT, Tensor | None]:
    """One iteration: the loss, without its gradient graph, and the view-space gradient if it was tracked."""
    loss = hooks.loss(iteration, sample)
    gradients, screen_gradient = gradients_of(loss, adam.values, watch)
    with watch.stage("optimise"):
        adam.step(gradients, rates)
    return loss.detached(), screen_gradient


def gradients_of(
    loss: Loss, values: Mapping[Name, Tensor], watch: Stopwatch
) -> tuple[dict[Name, Tensor], Tensor | None]:
    """Gradients of the leaves, and the view-space gradient ``[N, 2]`` in pixels if it was tracked.

    Leaves that the loss does not depend on have no entry; if nothing is drawn there are no entries.
    """
    names = [name for name, value in values.items() if value.requires_grad and value.numel()]
    screen = loss.screen_offsets
    inputs = [*(values[name] for name in names), *(() if screen is None else (screen,))]
    if not inputs or not loss.total.requires_grad:
        return {}, None
    with watch.stage("backward"):
        found = torch.autograd.grad(loss.total, inputs, allow_unused=True)
    by_name = {name: gradient for name, gradient in zip(names, found, strict=False) if gradient is not None}
    return by_name, None if screen is None else found[-1]


@dataclass
class MeanOfSteps:
    """Sums of trained leaves over the iterations after ``after``.

    A leaf whose number of rows changes, because free Gaussians are pruned or spawned, starts again.
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

    def sums_of(self, name: ParameterName, value: Tensor, iteration: int) -> Tensor:
        """The sums of a leaf after ``iteration``, for who adds to them and then calls :meth:`count`."""
        if name not in self.sums or self.sums[name].shape != value.shape:
            self.counts[name] = int(iteration > self.after)
            self.sums[name] = value.detach() * float(self.counts[name])
        return self.sums[name]

    def count(self, iterations: int) -> None:
        """Count ``iterations`` (none if negative) whose leaves were added to all sums."""
        self.counts = {name: count + max(iterations, 0) for name, count in self.counts.items()}

    def apply(self, values: Mapping[ParameterName, Tensor]) -> None:
        """Set the leaves to their means, in place."""
        with torch.no_grad():
            for name, total in self.sums.items():
                if total.shape == values[name].shape:
                    values[name].copy_(total / self.counts[name])


class LastPass:
    """Mean loss terms and PSNR over the last visits of the views; tensors are read on access only.

    Args:
        after: number of first iterations to ignore. With ``n`` views the last ``2 n - 1`` iterations should be left:
            they contain every view, because they contain a whole pass.
        terms_after: the same for loss terms, where not every visit of a view has terms that can be compared.
    """

    def __init__(self, after: int = 0, *, terms_after: int | None = None) -> None:
        self.after, self._terms_after = after, after if terms_after is None else terms_after
        self._terms: dict[int, dict[str, Tensor]] = {}
        self._squared_errors: dict[int, Tensor] = {}

    def add(self, iteration: int, loss: ViewLoss, view: View, *, comparable: bool = True) -> None:
        """Record a view's result, replacing its earlier one; its loss terms only if they are ``comparable``."""
        error = loss.squared_error(view) if iteration > self.after else None
        terms = {name: value.detach() for name, value in loss.terms.items()}
        self.add_results(iteration, view.index, terms, error, comparable=comparable)

    def add_results(
        self, iteration: int, view_index: int, terms: dict[str, Tensor], error: Tensor | None, *, comparable: bool
    ) -> None:
        """As :meth:`add`, of terms and of the squared error, which may be None where it does not count."""
        if iteration > self.after and error is not None:
            self._squared_errors[view_index] = error
        if comparable and iteration > self._terms_after:
            self._terms[view_index] = terms

    @property
    def psnr(self) -> float:
        """Mean over views of the PSNR in dB, NaN before any view."""
        values = [-10.0 * math.log10(max(float(error), 1e-10)) for error in self._squared_errors.values()]
        return sum(values) / len(values) if values else math.nan

    @property
    def terms(self) -> dict[str, float]:
        """Mean of each loss term."""
        # Not every view has every term.
        names = dict.fromkeys(name for terms in self._terms.values() for name in terms)
        by_name = {name: [terms[name] for terms in self._terms.values() if name in terms] for name in names}
        return {name: float(torch.stack(values).mean()) for name, values in by_name.items()}
