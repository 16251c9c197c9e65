# SPDX-License-Identifier: Apache-2.0
"""Without a GPU: how many operations an online frame queues for one, and how often the host waits for it."""

from collections.abc import Callable
from dataclasses import replace

import pytest

from structgstream.kernels.cuda_library import KernelLibrary
from structgstream.kernels.native import native_reason
from structgstream.session.presets import COMPACT
from structgstream.training.online.exposure import exposure_reference
from structgstream.training.online.fit import fit_next_frame
from structgstream.training.online.preprocess import preprocess
from structgstream.training.residuals import residual_floor
from structgstream.training.views import training_views
from tests.support.counted_gpu import counted_gpu
from tests.support.pretended_gpu import DEVICE, moved
from tests.support.worlds import moving_world

pytestmark = pytest.mark.skipif(native_reason() is not None, reason=str(native_reason()))

MAX_OPERATIONS, MAX_WAITS, MAX_OF_A_VIEW = 1_200, 18, 16
"""Of the frame below with four views, and operations of each further view: what it takes now, with little room. Whoever
needs fewer lowers them."""


@pytest.mark.parametrize("views", [4, 9])
def test_an_online_frame(
    emulation: Callable[[int], KernelLibrary], monkeypatch: pytest.MonkeyPatch, views: int
) -> None:
    world = moving_world(2, movers=20, cameras=views + 1)
    config = replace(COMPACT.online, iterations=40)
    with counted_gpu(emulation(0).library, monkeypatch) as (backend, counts):
        scene = moved(world.scene, DEVICE)
        with counts.paused():
            first = training_views(world.frames[0], world.rig, DEVICE)
            floor = residual_floor(scene, first, scale=config.motion.picture_scale, backend=backend)
            light = exposure_reference(scene, first, config=config.exposure)
        pictures = preprocess(
            world.frames[1],
            world.rig,
            before=world.frames[0],
            motion=config.motion,
            scene_flow=config.scene_flow,
            backend=backend,
        )
        fit = fit_next_frame(
            scene,
            world.frames[1],
            world.rig,
            config=config,
            backend=backend,
            seed=0,
            pictures=pictures,
            older=scene,
            floor=floor,
            light=light,
        )
    assert fit.moving > 0
    assert counts.operations.total() <= MAX_OPERATIONS + MAX_OF_A_VIEW * (views - 4), counts.operations.most_common(20)
    assert counts.waits.total() <= MAX_WAITS, counts.waits.most_common(10)
