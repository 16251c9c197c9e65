# SPDX-License-Identifier: Apache-2.0
"""3DGS from scratch on a small world, and the parts of 3DGStream that can be looked at alone."""

from dataclasses import replace

import torch

from peers.captures import moving_capture
from structgstream.harmonics import Y0
from structgstream.scene.render import render
from structgstream.training.result import Step
from structgstream.training.views import training_views
from structgstream_studies.peers.additions import AdditionsConfig, spawned_at
from structgstream_studies.peers.gaussians import GaussiansConfig, fit_gaussians, initial_gaussians, point_colors
from structgstream_studies.peers.hash_grid import GridConfig
from structgstream_studies.peers.methods import TINY_METHODS
from structgstream_studies.peers.plain import PlainGaussians
from structgstream_studies.peers.threedgstream import apply_transformation, box_of, in_box
from structgstream_studies.peers.warm_up import WarmUpConfig, identity_loss, warm_up
from tests.support.backends import quickest_backend

BACKEND = quickest_backend()
CAPTURE = moving_capture(1)
POINTS = torch.from_numpy(CAPTURE.points)
CONFIG: GaussiansConfig = TINY_METHODS["3dgs"].config


def mean_psnr(gaussians: PlainGaussians) -> float:
    found = []
    for view in training_views(CAPTURE.pictures[0], CAPTURE.rig, BACKEND.device):
        image = render(gaussians, view.camera, BACKEND).image.clamp(0, 1)
        found.append(-10 * float((image - view.image / 255.0).square().mean().log10()))
    return sum(found) / len(found)


def test_a_fit_is_better_than_its_start_and_repeats() -> None:
    steps: list[Step] = []
    fits = [
        fit_gaussians(
            CAPTURE.pictures[0], CAPTURE.rig, POINTS, config=CONFIG, backend=BACKEND, seed=3, on_step=steps.append
        )
        for _ in range(2)
    ]
    start = initial_gaussians(POINTS, training_views(CAPTURE.pictures[0], CAPTURE.rig, BACKEND.device), CONFIG)
    assert mean_psnr(fits[0].scene.gaussians) > mean_psnr(start) + 2.0
    for name, value in fits[0].scene.gaussians.tensors().items():
        assert torch.equal(value, getattr(fits[1].scene.gaussians, name)), name
    assert [step.iteration for step in steps] == 2 * list(range(1, CONFIG.iterations + 1))
    assert fits[0].spawned > 0
    assert abs(float(fits[0].scene.camera_color.gains.mean()) - 1.0) < 1e-5
    assert not torch.equal(fits[0].scene.camera_color.gains, torch.ones_like(fits[0].scene.camera_color.gains))


def test_without_camera_colour_the_correction_is_the_identity() -> None:
    config = replace(CONFIG, camera_color=False, iterations=3, coarse_iterations=0)
    fit = fit_gaussians(CAPTURE.pictures[0], CAPTURE.rig, POINTS, config=config, backend=BACKEND, seed=3)
    assert torch.equal(fit.scene.camera_color.gains, torch.ones(4, 3))


def test_a_point_starts_with_the_colour_that_the_views_show_there() -> None:
    views = training_views(CAPTURE.pictures[0], CAPTURE.rig, BACKEND.device)
    point = torch.tensor([0.05, 0.03, 0.02, 1.0])
    behind = torch.stack([point[:3], torch.tensor([0.0, 0.0, -50.0])])
    colors = point_colors(behind, views)
    shown = []
    for view in views:
        local = view.camera.viewmat @ point.double()
        column, row = ((view.camera.K @ local[:3])[:2] / local[2]).long().tolist()
        shown.append(view.image[row, column] / 255.0)
    torch.testing.assert_close(colors[0], torch.stack(shown).median(0).values)
    assert colors[1].tolist() == [0.5] * 3
    start = initial_gaussians(POINTS, views, replace(CONFIG, voxel_size=0.0))
    torch.testing.assert_close(start.base_colors * Y0 + 0.5, point_colors(POINTS.float(), views))
    assert len(start) == len(POINTS)


def test_the_warmed_up_cache_moves_nothing_and_repeats() -> None:
    grid = GridConfig(levels=4, log2_rows=10, base=4, hidden=16)
    positions = torch.rand(200, 3, generator=torch.Generator().manual_seed(0))
    config = WarmUpConfig(iterations=300, rate=2e-3, batch=128, batches=4)
    cache, loss = warm_up(positions, config=config, grid=grid, backend=BACKEND, seed=1)
    again, _ = warm_up(positions, config=config, grid=grid, backend=BACKEND, seed=1)
    assert torch.equal(cache.grid, again.grid)
    assert loss < 0.05
    untrained, before = warm_up(positions, config=replace(config, iterations=1), grid=grid, backend=BACKEND, seed=1)
    assert before > 1.0
    assert not torch.equal(untrained.network, cache.network)


def test_the_identity_has_no_loss() -> None:
    outputs = torch.tensor([[0, 0, 0, 1.0, 0, 0, 0, 1.0], [0, 0, 0, -2.0, 0, 0, 0, 1.0]])
    torch.testing.assert_close(identity_loss(outputs), torch.tensor(0.0))
    turned = torch.tensor([[0, 0, 0.3, 1.0, 1.0, 0, 0, 0.5]])
    torch.testing.assert_close(identity_loss(turned), torch.tensor(0.1 + 0.5 + 0.5))


def row(count: int) -> PlainGaussians:
    empty = PlainGaussians.empty(1, torch.zeros(0)).tensors()
    generator = torch.Generator().manual_seed(count)
    return PlainGaussians(
        **{name: torch.randn(count, *value.shape[1:], generator=generator) for name, value in empty.items()}
    )


def test_only_what_is_in_the_box_moves() -> None:
    base = row(300)
    box = box_of(base.means, 0.866)
    rows, positions = in_box(base.means, box)
    share = len(rows) / 300
    assert 0.5 < share < 0.75  # 0.866 cubed
    assert (positions >= 0).all()
    assert (positions <= 1).all()
    outputs = torch.zeros(len(rows), 8)
    outputs[:, 0], outputs[:, 3] = 2.0, 1.0
    after = apply_transformation(base, rows, outputs, 0.5)
    expected = base.means.clone()
    expected[rows, 0] += 1.0
    torch.testing.assert_close(after.means, expected)
    torch.testing.assert_close(after.quats, torch.nn.functional.normalize(base.quats, dim=1))


def test_children_are_drawn_from_twice_the_deviation() -> None:
    parents = row(1)
    parents = parents.select(torch.zeros(4000, dtype=torch.int64))
    children = spawned_at(parents, AdditionsConfig(), torch.Generator().manual_seed(0))
    offsets = children.means - parents.means
    expected = (2 * parents.log_scales[0].exp()).square().sum()
    torch.testing.assert_close(offsets.square().sum(1).mean(), expected, rtol=0.1, atol=0)
    torch.testing.assert_close(children.log_scales.exp(), parents.log_scales.exp() / 0.8)
    torch.testing.assert_close(children.logit_opacities.sigmoid(), torch.full((4000,), 0.1))
    assert children.quats[0].tolist() == [1, 0, 0, 0]
    assert children.sh is parents.sh
