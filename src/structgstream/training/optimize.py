# SPDX-License-Identifier: Apache-2.0
"""The loop of every fit: a view, its loss, one step of Adam.

What fits differ in is in their hooks: which loss a view has, and what happens between steps (growing, patching,
stopping early). ``training/initial.py``, ``training/online.py`` and every peer use this loop.
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
    """How long to optimise and how fast.

    Args:
        iterations: steps at most.
        rates: learning rate of every leaf in an iteration, counted from 1.
        before: steps of the frame in stages before this one, for progress.
        after: steps of the frame in stages after this one, for progress.
    """

    iterations: int
    rates: Callable[[int], Mapping[Name, float]]
    before: int = 0
    after: int = 0


class Hooks(ABC, Generic[SampleT, LossT]):
    """What one kind of fit does in an iteration, counted from 1."""

    @abstractmethod
    def loss(self, iteration: int, sample: SampleT) -> LossT:
        """The loss of a sample: a view of the frame, or whatever else the iterator gives."""

    def after_step(self, iteration: int, sample: SampleT, loss: LossT, screen_gradient: Tensor | None) -> None:
        """What follows the step: statistics, births and deaths.

        ``screen_gradient`` ``[N, 2]`` is that of the loss by screen positions in pixels; None if it was not tracked.
        """

    def finished(self, iteration: int) -> bool:
        """Whether no step is needed after so many."""
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
    """Step the leaves of ``adam`` down the losses of ``samples``; returns the number of iterations done.

    Args:
        adam: the leaves that collect gradients are moved.
        samples: without end; one for each iteration.
        schedule: how long and how fast.
        hooks: the loss, and what else happens.
        watch: gets the seconds of stages ``backward`` and ``optimise``.
        on_step: told of every iteration; on a GPU, which is waited for to know the loss, of every tenth.
    """
    told_every = 1 if adam.backend.device.type == "cpu" else 10
    total = schedule.before + schedule.iterations + schedule.after
    iteration = 0
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
    return iteration


def gradients_of(
    loss: Loss, values: Mapping[Name, Tensor], watch: Stopwatch
) -> tuple[dict[Name, Tensor], Tensor | None]:
    """Gradients of the leaves, and of the screen positions ``[N, 2]`` in pixels when they were tracked.

    A leaf that the view did not touch has no entry; where nothing is drawn there is none at all.
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
