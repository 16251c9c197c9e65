# SPDX-License-Identifier: Apache-2.0
"""The loop of every fit, on a loss of one number, and the gradients of a view."""

from dataclasses import dataclass, field, replace
from itertools import cycle

import pytest
import torch
from torch import Tensor

from structgstream.scene.state import PAPER_DYNAMIC
from structgstream.training.losses import Loss
from structgstream.training.optim import Adam, Hooks, Schedule, gradients_of, leaves, minimize
from structgstream.training.parameters import FREE_ROWS, Parameters, parameters_of_fields
from structgstream.training.result import Step, Stopwatch
from tests.support.backends import quickest_backend
from tests.support.rigs import random_scene
from tests.training.test_step import loss_of


@dataclass
class Parabola(Hooks[float, Loss]):
    """(x - sample)^2."""

    adam: Adam[str]
    seen: list[tuple[str, int, float]] = field(default_factory=list)

    def loss(self, iteration: int, sample: float) -> Loss:
        self.seen.append(("loss", iteration, sample))
        total = (self.adam.values["x"] - sample).square().sum()
        return Loss(total, {"parabola": total})

    def after_step(self, iteration: int, sample: float, loss: Loss, screen_gradient: Tensor | None) -> None:
        assert screen_gradient is None
        self.seen.append(("after", iteration, self.adam.values["x"].item()))

    def counts(self) -> tuple[int, int]:
        return 3, 4


def run(iterations: int, **stages: int) -> tuple[int, Parabola, list[Step]]:
    adam = Adam(quickest_backend(), leaves({"x": torch.zeros(1)}))
    hooks, steps = Parabola(adam), []
    schedule = Schedule(iterations, lambda iteration: {"x": 0.1 * iteration}, **stages)
    done = minimize(adam, cycle([1.0, 2.0]), schedule, hooks, watch=Stopwatch(), on_step=steps.append)
    return done, hooks, steps


def test_each_iteration_takes_a_sample_steps_and_tells_the_hooks() -> None:
    done, hooks, steps = run(3)
    assert done == 3
    assert [entry[:2] for entry in hooks.seen] == [(what, i) for i in (1, 2, 3) for what in ("loss", "after")]
    assert [sample for what, _, sample in hooks.seen if what == "loss"] == [1.0, 2.0, 1.0]
    after = [x for what, _, x in hooks.seen if what == "after"]
    assert after[0] == pytest.approx(0.1)  # Adam's first step is its rate, which is that of iteration 1.
    assert after[1] - after[0] == pytest.approx(0.2, rel=0.1)
    assert steps[0] == Step(1, 3, 1.0, 3, 4)
    assert [step.iteration for step in steps] == [1, 2, 3]


def test_progress_counts_all_stages_of_a_frame() -> None:
    steps = run(2, before=5, after=3)[2]
    assert [(step.iteration, step.iterations) for step in steps] == [(6, 10), (7, 10)]


def test_empty_and_fixed_leaves_have_no_gradient() -> None:
    values = {**leaves({"x": torch.ones(2), "none": torch.zeros(0)}), "fixed": torch.ones(2)}
    total = (values["x"] * values["fixed"]).sum() + values["none"].sum()
    gradients, screen = gradients_of(Loss(total, {}), values, Stopwatch())
    assert (list(gradients), screen) == (["x"], None)
    assert gradients_of(Loss(values["fixed"].sum(), {}), values, Stopwatch()) == ({}, None)
    scene = random_scene()
    parameters = Parameters.of(scene, trained=frozenset(FREE_ROWS))
    assert gradients_of(loss_of(parameters, scene)[0], parameters.values, Stopwatch())[0] == {}


def test_gradients_reach_exactly_the_trained_parameters() -> None:
    scene = random_scene(free=3)
    parameters = Parameters.of(scene, trained=parameters_of_fields(PAPER_DYNAMIC))
    loss, _ = loss_of(parameters, scene)
    gradients, screen = gradients_of(loss, parameters.values, Stopwatch())
    assert set(gradients) == parameters_of_fields(PAPER_DYNAMIC)
    assert screen is not None
    assert screen.shape == (len(loss.rendering.gaussians), 2)
    assert all(gradient.abs().sum() > 0 for gradient in gradients.values())


def test_a_view_that_shows_nothing_has_no_gradients() -> None:
    scene = random_scene(free=0)
    opaque = scene.mlps.opacity
    hidden = opaque._replace(w2=torch.zeros_like(opaque.w2), b2=torch.full_like(opaque.b2, -1.0))
    scene = replace(scene, mlps=scene.mlps._replace(opacity=hidden))
    parameters = Parameters.of(scene, trained=parameters_of_fields(PAPER_DYNAMIC))
    loss, _ = loss_of(parameters, scene, volume=0.0)
    assert len(loss.rendering.gaussians) == 0
    gradients, screen = gradients_of(loss, parameters.values, Stopwatch())
    assert all(not gradient.any() for gradient in gradients.values())
    assert screen is None or not len(screen)
