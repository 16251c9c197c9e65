# SPDX-License-Identifier: Apache-2.0
"""The optimisation loop of all fits: a view, its loss, one Adam step.

Fits differ in their hooks: the loss of a view, and the actions between steps (growing, patching, early stopping).
``training/initial.py``, ``training/online.py`` and the methods of studies use this loop.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Hashable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Generic, TypeVar

import torch
from torch import Tensor

from structgstream.kernels.cuda_graph import Recorder
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
        """The loss of a sample, which usually is a view of the frame; what else there is to do belongs in
        :meth:`after_step`, since this may be recorded."""

    def after_step(self, iteration: int, sample: SampleT, loss: LossT, screen_gradient: Tensor | None) -> None:
        """Called after the step: statistics, spawning, pruning.

        ``screen_gradient`` ``[N, 2]`` is the view-space gradient in pixels; None if it was not tracked.
        """

    def repeats(self, iteration: int, sample: SampleT) -> Hashable | None:
        """Key of the iterations that run the same operations on the same tensors as this one; None if no later one
        does. On a GPU these are recorded, without what the hooks do between steps.
        """
        return None

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
    recorder: Recorder[tuple[LossT, Tensor | None]] | None = None,
) -> int:
    """Minimise the losses of ``samples`` over the leaves of ``adam``; returns the number of iterations done.

    Args:
        adam: with the leaves.
        samples: an endless iterator; one sample per iteration.
        schedule: number of iterations and learning rates.
        hooks: the loss, and the actions between steps.
        watch: gets the seconds of stages ``backward`` and ``optimise``.
        on_step: called after every iteration; on a GPU, where reading the loss synchronises, after every tenth.
        recorder: records iterations that repeat (``kernels.cuda_graph``); None: all are run one by one.
    """
    told_every = 1 if adam.backend.device.type == "cpu" else 10
    total = schedule.before + schedule.iterations + schedule.after
    iteration = schedule.done
    recorded = None if recorder is None else RecordedRates.of(schedule, adam)
    while iteration < schedule.iterations and not hooks.finished(iteration):
        iteration += 1
        sample = next(samples)
        rates = schedule.rates(iteration) if recorded is None else recorded.at(iteration)
        take = partial(_take_step, adam, hooks, iteration, sample, rates, watch)
        # The first iteration is never recorded: libraries set themselves up in it.
        key = None if recorder is None or iteration == schedule.done + 1 else hooks.repeats(iteration, sample)
        if recorder is None or key is None:
            loss, screen_gradient = take()
        else:
            if key not in recorder:
                recorder.record(key, take)
            with watch.stage("replay"):
                loss, screen_gradient = recorder.replay(key)
        hooks.after_step(iteration, sample, loss, screen_gradient)
        if on_step is not None and iteration % told_every == 0:
            on_step(Step(schedule.before + iteration, total, float(loss.total.detach()), *hooks.counts()))
    return iteration - schedule.done


def _take_step(
    adam: Adam[Name],
    hooks: Hooks[SampleT, LossT],
    iteration: int,
    sample: SampleT,
    rates: Mapping[Name, float | Tensor],
    watch: Stopwatch,
) -> tuple[LossT, Tensor | None]:
    """One iteration: the loss, without its gradient graph, and the view-space gradient if it was tracked."""
    loss = hooks.loss(iteration, sample)
    gradients, screen_gradient = gradients_of(loss, adam.values, watch)
    with watch.stage("optimise"):
        adam.step(gradients, rates)
    return loss.detached(), screen_gradient


@dataclass(frozen=True)
class RecordedRates(Generic[Name]):
    """Learning rates of all iterations of a schedule, for steps that are recorded.

    Args:
        first: the iteration of the first row of ``table``.
        table: ``[iterations, P]`` float32 on the device.
        current: ``[P]``, a row of the table; recorded steps read it.
        rates: views of ``current`` by name; 0 for leaves that are not trained.
    """

    first: int
    table: Tensor
    current: Tensor
    rates: Mapping[Name, float | Tensor]

    @classmethod
    def of(cls, schedule: Schedule[Name], adam: Adam[Name]) -> "RecordedRates[Name]":
        """The rates of the leaves that ``schedule`` trains, whose steps are counted on the device from now on."""
        first = schedule.done + 1
        rows = [schedule.rates(iteration) for iteration in range(first, schedule.iterations + 1)]
        names = tuple(name for name, value in adam.values.items() if value.requires_grad and any(r[name] for r in rows))
        adam.count_on_device(names)
        table = torch.tensor([[row[name] for name in names] for row in rows], device=adam.backend.device)
        current = table.new_zeros(len(names))
        return cls(first, table, current, {**dict.fromkeys(adam.values, 0.0), **dict(zip(names, current, strict=True))})

    def at(self, iteration: int) -> Mapping[Name, float | Tensor]:
        """Writes the rates of ``iteration`` into ``current``."""
        self.current.copy_(self.table[iteration - self.first])
        return self.rates


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
