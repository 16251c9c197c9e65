# SPDX-License-Identifier: Apache-2.0

import torch

from structgstream.kernels.backend import reference_backend
from structgstream.training.frame0.densify import Densifier, GrowthConfig
from structgstream.training.optim import Adam
from structgstream.training.parameters import ANCHOR_ROWS, Parameters
from tests.support.rigs import arc_rig, random_scene

CONFIG = GrowthConfig(collect_from=0, start=0, interval=5, eligible_count=0, prune_visits=0)
TRAINED = [name for name in ANCHOR_ROWS if name != "appearance"]  # Frame 0 has no change of appearance.


def prepared():
    scene = random_scene(30)
    parameters = Parameters.of(scene, trained=frozenset(TRAINED))
    densifier = Densifier.of(scene, config=CONFIG, iterations=1000, voxel_size=0.01)
    adam = Adam(reference_backend(), parameters.values)
    adam.step({name: torch.ones_like(parameters.values[name]) for name in TRAINED}, dict.fromkeys(TRAINED, 1e-9))
    return scene, parameters, densifier, adam


def test_schedule() -> None:
    densifier = prepared()[2]
    assert [i for i in range(12) if densifier.is_due(i)] == [5, 10]
    late = scheduled(GrowthConfig(start=5, stop=9, interval=3), iterations=20)
    assert [i for i in range(20) if late.is_due(i)] == [6, 9]
    assert not late.collects(500)


def scheduled(config: GrowthConfig, *, iterations: int) -> Densifier:
    return Densifier.of(random_scene(3), config=config, iterations=iterations, voxel_size=0.01)


def test_nothing_grows_that_is_not_fitted() -> None:
    paper = scheduled(GrowthConfig(), iterations=4000)
    due = [i for i in range(4001) if paper.is_due(i)]
    assert (due[0], due[-1], len(due)) == (1600, 3900, 24)
    assert paper.collects(3900)
    assert not paper.collects(3901)  # Nobody would ask.


def test_every_table_keeps_its_rows_in_step() -> None:
    scene, parameters, densifier, adam = prepared()
    densifier.gradients.total.fill_(1.0)
    densifier.gradients.count.fill_(1.0)
    densifier.opacities.visits.fill_(1.0)
    densifier.opacities.opacity[:] = torch.where(torch.arange(30) < 4, 0.0, 1.0)
    densifier.apply(scene, adam, torch.Generator().manual_seed(0), iteration=5)
    assert densifier.pruned == 4
    assert densifier.grown > 0
    rows = 30 - 4 + densifier.grown
    for name in TRAINED:
        assert parameters.values[name].shape[0] == rows
        assert parameters.values[name].requires_grad
        assert adam.first[name].shape == parameters.values[name].shape
        assert (adam.first[name][26:] == 0).all()
        assert (adam.first[name][:26] != 0).all()
    assert torch.allclose(parameters.values["anchor_features"][:26], scene.anchors.features[4:], atol=1e-6)
    assert densifier.opacities.visits.shape == (rows,)
    assert densifier.gradients.count.shape == (rows * 5,)
    assert (densifier.gradients.count == 0).all()  # All were eligible, so all start again.
    assert (parameters.values["anchor_offsets"][26:] == 0).all()


def test_base_scales_are_bounded() -> None:
    scene, parameters, densifier, adam = prepared()
    parameters.values["base_scales"].detach().fill_(3.0)
    densifier.apply(scene, adam, torch.Generator(), iteration=5)
    assert parameters.values["base_scales"].max() <= 0.05


def test_statistics_follow_renderings() -> None:
    scene, _, densifier, _ = prepared()
    structured = scene.structured(arc_rig()["cam01"], reference_backend())
    densifier.opacities.add(structured)
    assert densifier.opacities.visits[structured.anchors].eq(1.0).all()
    expected = torch.zeros(30).index_add_(0, structured.gaussians.ids // 5, structured.gaussians.opacities)
    assert torch.allclose(densifier.opacities.opacity, expected, atol=1e-6)
