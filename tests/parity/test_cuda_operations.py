# SPDX-License-Identifier: Apache-2.0
"""Without a GPU: how many operations an online frame queues for one, and how often the host waits for it."""

from collections.abc import Callable
from dataclasses import replace

import pytest

from structgstream.kernels.cuda_library import KernelLibrary
from structgstream.kernels.native import native_reason
from structgstream.session.presets import COMPACT
from structgstream.training.online.fit import fit_next_frame
from structgstream.training.online.preprocess import preprocess
from tests.support.counted_gpu import counted_gpu
from tests.support.pretended_gpu import DEVICE, moved
from tests.support.worlds import moving_world

pytestmark = pytest.mark.skipif(native_reason() is not None, reason=str(native_reason()))

MAX_OPERATIONS, MAX_WAITS = 3_300, 180
"""Of the frame below: what it takes now, with little room. Whoever needs fewer lowers them."""


def test_an_online_frame(emulation: Callable[[int], KernelLibrary], monkeypatch: pytest.MonkeyPatch) -> None:
    world = moving_world(2, movers=20)
    config = replace(COMPACT.online, iterations=40)
    with counted_gpu(emulation(0).library, monkeypatch) as (backend, counts):
        pictures = preprocess(
            world.frames[1],
            world.rig,
            before=world.frames[0],
            motion=config.motion,
            scene_flow=config.scene_flow,
            backend=backend,
        )
        scene = moved(world.scene, DEVICE)
        fit = fit_next_frame(
            scene, world.frames[1], world.rig, config=config, backend=backend, seed=0, pictures=pictures
        )
    assert fit.moving > 0
    assert counts.operations.total() <= MAX_OPERATIONS, counts.operations.most_common(20)
    assert counts.waits.total() <= MAX_WAITS, counts.waits.most_common(10)
