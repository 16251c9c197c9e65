# SPDX-License-Identifier: Apache-2.0
"""Recorded work beside the same work run one by one, on a GPU."""

from dataclasses import replace

import pytest
import torch

from structgstream.kernels.backend import cuda_backend
from structgstream.kernels.cuda_graph import GraphMemory
from structgstream.scene.state import state_of
from structgstream.training.online.config import MotionConfig, OnlineConfig, PatchingConfig, SmoothnessConfig
from structgstream.training.online.fit import fit_next_frame
from structgstream.training.online.preprocess import preprocess
from structgstream.training.views import training_views
from tests.support.backends import quickest_backend
from tests.support.pretended_gpu import moved
from tests.support.recorders import Repeater
from tests.support.worlds import moving_world


@pytest.mark.needs_cuda
def test_a_replay_reads_new_numbers_and_writes_into_the_first_result() -> None:
    recorder = GraphMemory(torch.device("cuda")).recorder()
    weights, rate = torch.ones(64, 64, device="cuda", requires_grad=True), torch.zeros((), device="cuda")

    def work() -> tuple[torch.Tensor]:
        loss = (weights @ weights).square().mean()
        (gradient,) = torch.autograd.grad(loss, weights)
        weights.data.sub_(rate * gradient)
        return (loss.detach(),)

    work()  # Libraries set themselves up.
    recorder.record("step", work)
    assert weights.detach().eq(1.0).all()  # Recording runs nothing.
    assert "step" in recorder
    assert "other" not in recorder
    assert (len(recorder), recorder.replays) == (1, 0)
    losses = []
    for value in (0.0, 0.1, 0.1):
        rate.fill_(value)
        (loss,) = recorder.replay("step")
        losses.append(float(loss))
    assert losses[0] == losses[1] == 64.0**2
    assert losses[2] < losses[1]


@pytest.mark.needs_cuda
def test_what_spoils_a_recording_is_reported_and_the_next_one_works() -> None:
    recorder = GraphMemory(torch.device("cuda")).recorder()
    value = torch.ones(3, device="cuda")

    def waits() -> tuple[torch.Tensor]:
        raise ValueError("spoilt")

    with pytest.raises(ValueError, match="spoilt"):
        recorder.record("bad", waits)
    assert "bad" not in recorder
    recorder.record("good", lambda: (value.mul_(2.0),))
    recorder.replay("good")
    assert value.tolist() == [2.0, 2.0, 2.0]


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.needs_cuda)])
def test_a_frame_of_recorded_iterations_is_that_of_single_ones(device: str) -> None:
    """With all that an iteration has: prices of bits and motion, tiles at rest, the mean of the last ones."""
    world = moving_world(2, emerges_at=1)
    scene = moved(world.scene, torch.device(device))
    config = OnlineConfig(
        iterations=60,
        patching=PatchingConfig(spawn="off", iteration=30),
        motion=MotionConfig(enabled=True, rest_every=3),
        smoothness=SmoothnessConfig(weight=1e-4),
        mean_of_last=0.25,
    )
    # Iterations that a back-end runs itself are not recorded.
    single = replace(quickest_backend(), iterations=None) if device == "cpu" else replace(cuda_backend(), recorder=None)
    recorded = replace(single, recorder=Repeater) if device == "cpu" else cuda_backend()
    results = [
        fit_next_frame(
            scene,
            world.frames[1],
            world.rig,
            config=config,
            backend=backend,
            seed=0,
            pictures=preprocess(
                world.frames[1],
                world.rig,
                before=training_views(world.frames[0], world.rig, backend.device),
                motion=config.motion,
                scene_flow=config.scene_flow,
                backend=backend,
            ),
            steps={str(name): step for name, step in config.rounding.steps(0.01).items()},
        )
        for backend in (recorded, single)
    ]
    assert ["replay" in result.seconds for result in results] == [True, False]
    assert 2 * results[0].counts["recorded"] < results[0].counts["replayed"] < config.iterations
    assert "replayed" not in results[1].counts
    tolerance = 1e-5 if device == "cpu" else 0.15  # gsplat adds gradients in any order.
    ours, exact = (state_of(result.scene) for result in results)
    start = state_of(scene)
    for name in ("anchor_positions", "offset_scales"):
        assert (exact[name] - start[name]).norm() > 0.0
        assert (ours[name] - exact[name]).norm() <= tolerance * (exact[name] - start[name]).norm(), name
    assert results[0].train_psnr == pytest.approx(results[1].train_psnr, abs=1e-3 if device == "cpu" else 0.2)
    assert results[0].losses == pytest.approx(results[1].losses, rel=1e-4 if device == "cpu" else 0.1)
