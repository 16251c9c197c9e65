# SPDX-License-Identifier: Apache-2.0
"""The set of free Gaussians, pruned and spawned in the middle of a frame while it is optimized."""

from dataclasses import replace

import torch

from structgstream.scene.free import FreeGaussians
from structgstream.scene.state import ParameterName
from structgstream.training.losses import GradientStatistics
from structgstream.training.online.config import PatchingConfig
from structgstream.training.online.patching import IDS_PER_FRAME, FreeSet
from structgstream.training.optim import Adam
from structgstream.training.parameters import FREE_ROWS, Parameters, parameters_of_fields
from tests.support.backends import quickest_backend
from tests.support.worlds import moving_world

CPU = torch.device("cpu")
BACKEND = quickest_backend()
WORLD = moving_world(1)
LOOK = torch.full((3, 3), 0.1).log(), torch.tensor([[0.2, 0.4, 0.6]]).repeat(3, 1)
SCENE = replace(
    WORLD.scene,
    free=replace(
        FreeGaussians.spawned(torch.zeros(3, 3), *LOOK, opacity=0.5, first_identity=4),
        logit_opacities=torch.tensor([2.0, -9.0, 1.0]),  # The second is fainter than what survives.
    ),
)
SLOTS = len(SCENE.anchors) * SCENE.anchors.offsets_per_anchor


def ones(parameters: Parameters) -> dict[ParameterName, torch.Tensor]:
    return {name: torch.ones_like(parameters.values[name]) for name in FREE_ROWS}


def patch(*, room: int, dying_gradient: float = 0.0) -> tuple[FreeSet, torch.Tensor | None]:
    parameters = Parameters.of(SCENE, trained=parameters_of_fields({"free"}))
    adam = Adam(BACKEND, parameters.values)
    adam.step(ones(parameters), dict.fromkeys(FREE_ROWS, 0.0))
    statistics = GradientStatistics(SLOTS + 3, CPU)
    statistics.total[SLOTS] = 1.0  # Two free ones have large gradients, ...
    statistics.total[SLOTS + 1] = dying_gradient
    statistics.total[SLOTS + 2] = 2.0  # ... the last the largest.
    statistics.count[SLOTS:] = 1.0
    views = WORLD.views()
    population = FreeSet(
        config=PatchingConfig(),
        template=SCENE,
        parameters=parameters,
        adam=adam,
        statistics=statistics,
        views=views,
        frame_index=7,
        room=room,
        backend=BACKEND,
        generator=torch.Generator().manual_seed(0),
    )
    return population, population.patch(views[0])


def test_the_faint_die_and_children_follow_those_that_stay() -> None:
    population, keep = patch(room=10)
    parameters = population.parameters
    assert keep is not None
    assert keep.tolist() == [True, False, True]
    assert (population.spawned, population.pruned) == (2, 1)
    assert parameters.births.tolist() == [4, 6, 7 * IDS_PER_FRAME, 7 * IDS_PER_FRAME + 1]
    assert all(len(parameters.values[name]) == 4 for name in FREE_ROWS)
    assert torch.equal(parameters.values["free_logit_opacities"][:2], torch.tensor([2.0, 1.0]))
    torch.testing.assert_close(parameters.values["free_colors"][2:], torch.tensor([[0.2, 0.4, 0.6]] * 2))
    # Moments have gone the same way: another step takes them all.
    population.adam.step(ones(parameters), dict.fromkeys(FREE_ROWS, 0.1))


def test_who_dies_has_no_children() -> None:
    population, _ = patch(room=10, dying_gradient=3.0)
    assert population.pruned == 1
    assert population.spawned == 2
    assert len(population) == 4


def test_no_more_are_spawned_than_there_is_room_for_and_the_largest_gradient_comes_first() -> None:
    assert len(patch(room=10)[0]) == 4
    population, keep = patch(room=3)
    assert population.spawned == 1
    assert keep is not None
    assert len(population) == int(keep.sum()) + 1 == 3
    assert patch(room=2)[0].spawned == 0


def test_rows_stay_where_they_are_if_none_comes_or_goes() -> None:
    population, _ = patch(room=10)
    population.config = replace(population.config, spawn="off")
    before = dict(population.parameters.values)
    assert population.patch(population.views[0]) is None
    assert all(population.parameters.values[name] is before[name] for name in FREE_ROWS)
