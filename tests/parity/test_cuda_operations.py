# SPDX-License-Identifier: Apache-2.0
"""Without a GPU: how many operations an online frame queues for one, and how often the host waits for it."""

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch

from structgstream.kernels.cuda_library import KernelLibrary
from structgstream.scene.render import render_picture
from structgstream.scene.scene import Scene
from structgstream.session.presets import COMPACT
from structgstream.training.online.config import SceneFlowConfig
from structgstream.training.online.exposure import exposure_reference
from structgstream.training.online.fit import fit_next_frame
from structgstream.training.online.preprocess import preprocess
from structgstream.training.residuals import baseline_residual
from structgstream.training.result import FitResult
from structgstream.training.views import training_views
from tests.support.backends import needs_native
from tests.support.counted_gpu import Counts, counted_gpu
from tests.support.pretended_gpu import DEVICE, moved
from tests.support.worlds import moving_world

pytestmark = needs_native

MAX_OPERATIONS = {(4, False): 1_050, (27, False): 1_185, (4, True): 1_195, (27, True): 1_340}
"""By number of views, and whether much moves fast, so that there is a second round of flow: what the frame below takes
now, with little room. Whoever needs fewer lowers them."""
MAX_WAITS = 20
MAX_OF_PICTURE = 35, 2
"""Operations and waits of a picture of a scene with environment and free Gaussians, copied to the host as bytes."""
MAX_OF_ITERATION = 132, 3
"""Operations and waits of one iteration that runs in torch: for the anchors in view, their Gaussians, and the pairs."""


def second_frame(
    emulation: KernelLibrary, monkeypatch: pytest.MonkeyPatch, *, views: int, iterations: int, native: bool = True
) -> Counts:
    """Counts of the second frame of a stream: its first one uploads the cameras."""
    world = moving_world(3, movers=20, cameras=views + 1)
    config = replace(COMPACT.online, iterations=iterations)
    with counted_gpu(emulation.library, monkeypatch, native=native) as (backend, counts):
        scene = moved(world.scene, DEVICE)
        with counts.paused():
            first = training_views(world.frames[0], world.rig, DEVICE)
            baseline = baseline_residual(scene, first, scale=config.motion.picture_scale, backend=backend)
            light = exposure_reference(scene, first, config=config.exposure)
        shown = [first]

        def fit_frame(index: int, last: Scene, before_previous: Scene) -> FitResult[Scene]:
            pictures = preprocess(
                world.frames[index],
                world.rig,
                before=shown[-1],
                motion=config.motion,
                scene_flow=config.scene_flow,
                backend=backend,
            )
            shown.append(pictures.views)
            return fit_next_frame(
                last,
                world.frames[index],
                world.rig,
                config=config,
                backend=backend,
                seed=0,
                pictures=pictures,
                before_previous=before_previous,
                baseline=baseline,
                light=light,
            )

        with counts.paused():
            last = fit_frame(1, scene, scene).scene
        fit = fit_frame(2, last, scene)
    assert fit.moving > 0
    return counts


@pytest.mark.parametrize(("views", "fast"), MAX_OPERATIONS)
def test_an_online_frame(
    emulation: Callable[[int], KernelLibrary], monkeypatch: pytest.MonkeyPatch, views: int, fast: bool
) -> None:
    if fast:
        monkeypatch.setattr(SceneFlowConfig, "FEW_FAST", -1.0)
    counts = second_frame(emulation(0), monkeypatch, views=views, iterations=40)
    assert counts.operations.total() <= MAX_OPERATIONS[views, fast], counts.operations.most_common(20)
    assert counts.waits.total() <= MAX_WAITS, counts.waits.most_common(10)


def test_a_picture(emulation: Callable[[int], KernelLibrary], monkeypatch: pytest.MonkeyPatch) -> None:
    world = moving_world(3, movers=20, cameras=5)
    camera = world.rig["cam00"]
    with counted_gpu(emulation(0).library, monkeypatch, native=True) as (backend, counts):
        with counts.paused():
            scene = moved(replace(world.scene, environment=torch.full((9, 3), 0.1)), DEVICE)
            render_picture(scene, camera, backend)  # uploads the camera
        picture = render_picture(scene, camera, backend)
    assert picture.any()
    assert counts.operations.total() <= MAX_OF_PICTURE[0], counts.operations.most_common(20)
    assert counts.waits.total() <= MAX_OF_PICTURE[1], counts.waits.most_common(10)


def test_an_iteration_in_torch(emulation: Callable[[int], KernelLibrary], monkeypatch: pytest.MonkeyPatch) -> None:
    few, many = (
        second_frame(emulation(0), monkeypatch, views=4, iterations=iterations, native=False) for iterations in (20, 40)
    )
    operations = (many.operations - few.operations).total() / 20
    assert operations <= MAX_OF_ITERATION[0], (many.operations - few.operations).most_common(20)
    assert (many.waits - few.waits).total() / 20 <= MAX_OF_ITERATION[1]
