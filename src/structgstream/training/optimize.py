# SPDX-License-Identifier: Apache-2.0
"""The optimisation loop of all fits: a view, its loss, one Adam step.

Fits differ in their hooks: the loss of a view, and the actions between steps (growing, patching, early stopping).
``training/initial.py``, ``training/online.py`` and all peers use this loop.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Generic, TypeVar

import torch
from torch import Tensor

from structgstream.training.optim import Adam, Name
from structgstream.training.result import Step, StepListener
from structgstream.training.step import Loss
from structgstream.training.stopwatch import Stopwatch

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
        """The loss of a sample, which usually is a view of the frame."""

    def after_step(self, iteration: int, sample: SampleT, loss: LossT, screen_gradient: Tensor | None) -> None:
        """Called after the step: statistics, spawning, pruning.

        ``screen_gradient`` ``[N, 2]`` is the view-space gradient in pixels; None if it was not tracked.
        """

    def finished(self, iteration: int) -> bool:
        """Whether to stop after this iteration."""
        return False

    def counts(self) -> tuple[int, int]:
        """Anchors and free Gaussians, for progress."""
        return 0, 0


def optimize(
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
    told_every = 1 if adam.backend.device.type == "cpu" else 10
    total = schedule.before + schedule.iterations + schedule.after
    iteration = schedule.done
    while iteration < schedule.iterations and not hooks.finished(iteration):
        iteration += 1
        sample = next(samples)
        loss = hooks.loss(iteration, sample)
        gradients, screen_gradient = gradients_of(loss, adam.values, watch)
        with watch.stage("optimise"):
            adam.step(gradients, schedule.rates(iteration))
        hooks.after_step(iteration, sample, loss, screen_gradient)
        if on_step is not None and iteration % told_every == 0:
            on_step(Step(schedule.before + iteration, total, float(loss.total.detach()), *hooks.counts()))
    return iteration - schedule.done


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
