# SPDX-License-Identifier: Apache-2.0
"""The iterations of a later frame in C++ beside the loop in torch over the same kernels and over the reference's."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any, cast

import pytest
import torch
from torch import Tensor

from structgstream.errors import OutOfMemoryError
from structgstream.kernels import cpu_fit
from structgstream.kernels.backend import Backend, cpu_backend, reference_backend
from structgstream.kernels.values import TileSelection, tile_grid
from structgstream.scene.active_tiles import ActiveTiles
from structgstream.scene.sampling import RigSampling
from structgstream.scene.scene import Scene
from structgstream.scene.state import state_of
from structgstream.session.presets import PRESETS
from structgstream.training.losses import LossWeights
from structgstream.training.online import iterations
from structgstream.training.online.config import MotionConfig, OnlineConfig, PatchingConfig, SmoothnessConfig
from structgstream.training.online.iterations import StartingPoint, unknown_natively
from structgstream.training.online.optimize import FrameOptimizer
from structgstream.training.online.split import DynamicSplit
from structgstream.training.parameters import RoundingConfig
from structgstream.training.result import FitResult, Step, Stopwatch
from structgstream.training.views import View, blackened
from tests.parity.conftest import check_any_threads
from tests.support.backends import needs_native
from tests.support.rigs import random_scene
from tests.support.worlds import moving_world

pytestmark = needs_native
WORLD = moving_world(2)
CONFIG = OnlineConfig(
    iterations=11,
    dynamic=frozenset(
        {"anchor_positions", "offset_scales", "base_scales", "anchor_offsets", "anchor_features", "appearance", "free"}
    ),
    losses=LossWeights(l1=0.6, ssim=0.45, volume=0.01),
    patching=PatchingConfig(spawn="off", iteration=5),
    motion=MotionConfig(enabled=True, rest_every=2),
    smoothness=SmoothnessConfig(weight=8e-4),
    mean_of_last=0.7,
    rounding=RoundingConfig(free_priced=True),
)
STEPS = {"anchor_positions": 0.01, "appearance": 1 / 16, "free_means": 0.01, "free_colors": 1 / 128}
PLAIN = {"smoothness": SmoothnessConfig(), "mean_of_last": 0.0, "rounding": RoundingConfig(rate_weight=0.0)}
"""Without smoothness, mean of steps and rate term."""


def scene_of(*, appears: bool, free: int) -> Scene:
    scene, g = random_scene(60, free=free, cameras=4, seed=4), torch.Generator().manual_seed(1)
    scene.free.logit_opacities[: free // 3] = -9.0  # pruned
    if appears:
        anchors = replace(scene.anchors, appearance=0.1 * torch.randn(60, 4, generator=g))
        scene = replace(scene, anchors=anchors, appearance_basis=torch.randn(4, 32, generator=g))
    return replace(scene, sampling=RigSampling.of(WORLD.rig))


def tiles_of(views: list[View], *, first: int, last: int) -> TileSelection:
    camera = views[0].camera
    mask = torch.zeros(tile_grid(camera.width, camera.height), dtype=torch.bool)
    mask.view(-1)[first:last] = True
    return TileSelection(mask, camera.width, camera.height)


def start_of(scene: Scene) -> StartingPoint:
    views = WORLD.views(1)
    counts = torch.ones(views[1].image.shape[:2], dtype=torch.bool)
    counts[5:19, 10:30] = False
    views[1] = replace(views[1], image=blackened(views[1].image, counts), mask=counts)
    anchors = torch.arange(60) < 40
    selection = SimpleNamespace(anchors=anchors, free=torch.ones(len(scene.free), dtype=torch.bool))
    split = DynamicSplit.of(scene, cast(Any, selection))
    backend, tiles = reference_backend(), tiles_of(views, first=0, last=5)
    active = {
        view.index: ActiveTiles(
            tiles,
            torch.full(view.image.shape, 0.3),
            split.static.without_free().gaussians(view.camera, backend),
            tiles_of(views, first=1, last=3),
            torch.tensor([0.1, 0.2, 0.3]) if view is views[0] else None,
        )
        for view in views[:3]
    }
    displacements = 0.01 * torch.randn(40 + len(scene.free), 3, generator=torch.Generator().manual_seed(2))
    return StartingPoint(split.dynamic, views, displacements, split, active)


def fitted(
    backend: Backend, *, appears: bool = True, free: int = 9, reported: list[Step] | None = None, **changes: Any
) -> FitResult[Scene]:
    on_step = None if reported is None else reported.append
    config, generator = replace(CONFIG, **changes), torch.Generator().manual_seed(3)
    optimizer = FrameOptimizer(config, backend, 1, generator, Stopwatch(), STEPS, on_step)
    return optimizer.run(start_of(scene_of(appears=appears, free=free)))


def in_torch(backend: Backend) -> Backend:
    return replace(backend, iterations=None)


@pytest.mark.parametrize("loss", [LossWeights(), LossWeights(volume_reduction="sum"), LossWeights(volume=0.0)])
def test_without_free_gaussians_results_are_those_of_the_loop_bit_for_bit(loss: LossWeights) -> None:
    one, two = (
        fitted(backend, appears=False, free=0, losses=loss) for backend in (cpu_backend(), in_torch(cpu_backend()))
    )
    before, after = state_of(one.scene), state_of(two.scene)
    assert all(torch.equal(value, after[name]) for name, value in before.items())
    assert one.losses == two.losses
    assert "iterations" in one.seconds
    assert "iterations" not in two.seconds


@dataclass(frozen=True)
class WithSize(LossWeights):
    size: float = 0.0


@pytest.mark.parametrize("size", [0.0, 0.1, 1])
def test_a_loss_that_they_do_not_know_is_minimised_in_torch(size: float) -> None:
    assert ("iterations" in fitted(cpu_backend(), losses=WithSize(size=size)).seconds) == (size == 0.0)


@dataclass(frozen=True)
class WithPenalty(OnlineConfig):
    penalty: float = 0.0


def test_settings_and_rows_that_they_do_not_know_are_found(monkeypatch: pytest.MonkeyPatch) -> None:
    plain, appearing = (scene_of(appears=appears, free=3) for appears in (False, True))
    settings = vars(PRESETS["compact"].online)
    assert unknown_natively(WithPenalty(**settings), appearing) == set()
    assert unknown_natively(WithPenalty(**settings, penalty=0.1), appearing) == {"penalty"}
    monkeypatch.setattr(iterations, "LEAVES", tuple(name for name in iterations.LEAVES if name != "appearance"))
    assert unknown_natively(CONFIG, plain) == set()
    assert unknown_natively(CONFIG, appearing) == {"appearance"}


@pytest.mark.parametrize("oracle", [cpu_backend, reference_backend])
@pytest.mark.parametrize("changes", [{}, PLAIN])
def test_results_are_those_of_the_loop(oracle: Callable[[], Backend], changes: dict[str, Any]) -> None:
    check_same_results(fitted(cpu_backend(), **changes), fitted(in_torch(oracle()), **changes))


def check_same_results(one: FitResult[Scene], two: FitResult[Scene]) -> None:
    start = state_of(start_of(scene_of(appears=True, free=9)).scene)
    before, after = state_of(one.scene), state_of(two.scene)
    assert one.pruned == two.pruned == 3
    for name, value in before.items():
        apart = (value - after[name]).float().norm()
        moved = (value - start[name][-len(value) :]).float().norm()
        # Adam steps by as much where a gradient is nearly zero.
        assert apart <= 1e-2 * moved + 1e-6 * value.float().norm(), (name, float(apart), float(moved))
    assert one.iterations == two.iterations
    assert one.train_psnr == pytest.approx(two.train_psnr, abs=1e-3)
    assert one.losses == pytest.approx(two.losses, rel=1e-4)


def test_results_do_not_depend_on_threads_nor_on_reports() -> None:
    reported = list[Step]()

    def results() -> Iterable[Tensor]:
        reports = reported if torch.get_num_threads() == 3 else None
        return state_of(fitted(cpu_backend(), reported=reports).scene).values()

    check_any_threads(results)
    assert [step.iteration for step in reported] == [4, 9]
    assert {step.anchors for step in reported} == {40}


@pytest.mark.parametrize("begun", [None, 1])
def test_no_memory(begun: int | None, monkeypatch: pytest.MonkeyPatch) -> None:
    library = SimpleNamespace(sgs_fit_new=lambda *_: begun, sgs_fit_run=lambda *_: 1, sgs_fit_free=lambda *_: None)
    monkeypatch.setattr(cpu_fit, "native_library", lambda: library)
    with pytest.raises(OutOfMemoryError, match="^Not enough memory"):
        fitted(cpu_backend())
