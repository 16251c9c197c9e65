# SPDX-License-Identifier: Apache-2.0
"""What the method keeps of a first frame, asks for, and refuses; its frames are fitted in ``test_session.py``."""

from dataclasses import replace

import pytest
import torch

from structgstream.errors import ConfigError
from structgstream.scene.scene import Scene
from structgstream.session.pipeline import FrameTask
from structgstream.session.presets import COMPACT, PAPER, StreamConfig
from structgstream.session.struct_gstream import FrameZeroContext, StructGStream, stream_pipeline
from structgstream.training.result import FitResult
from tests.support.backends import quickest_backend
from tests.support.rigs import random_scene
from tests.support.worlds import moving_world

WORLD = moving_world(1)


def with_parts(*, residuals: bool, light: bool) -> StreamConfig:
    online = COMPACT.online
    motion = replace(online.motion, residual_threshold=0.1 if residuals else 0.0)
    return replace(COMPACT, online=replace(online, motion=motion, exposure=replace(online.exposure, enabled=light)))


def task(method: StructGStream, *, begins: str | None = None) -> FrameTask:
    backend = quickest_backend()
    pictures = method.observe(WORLD.frames[0], None, rig=WORLD.rig, backend=backend)
    points = WORLD.scene.anchors.positions
    return FrameTask(WORLD.frames[0], pictures, WORLD.rig, lambda: points, backend, seed=0, begins=begins)


def never() -> FrameTask:
    raise AssertionError("The pictures were asked for.")


def test_a_first_frame_leaves_what_later_ones_use() -> None:
    def prepared(*, residuals: bool, light: bool) -> FrameZeroContext:
        method = StructGStream(with_parts(residuals=residuals, light=light))
        return method.prepare(WORLD.scene, lambda: task(method))

    both = prepared(residuals=True, light=True)
    assert both.baseline is not None
    assert both.baseline.maps.keys() == {0, 1, 2, 3}
    assert both.light is not None
    baseline_only, light_only = prepared(residuals=True, light=False), prepared(residuals=False, light=True)
    assert baseline_only.baseline is not None
    assert baseline_only.light is None
    assert light_only.baseline is None
    assert light_only.light is not None


def test_pictures_of_a_first_frame_are_not_read_where_nothing_is_kept() -> None:
    """A stream that resumes need not have them."""
    method = StructGStream(with_parts(residuals=False, light=False))
    assert method.prepare(WORLD.scene, never) == FrameZeroContext()


def test_earlier_pictures_and_frames_are_asked_for_where_they_are_used() -> None:
    def asks(config: StreamConfig) -> tuple[bool, bool]:
        method = StructGStream(config)
        return method.needs_before, method.needs_before_previous

    def of(*, motion: bool, prior: float, ease: float) -> StreamConfig:
        online = COMPACT.online
        selection = replace(online.motion, enabled=motion, hysteresis=ease)
        return replace(COMPACT, online=replace(online, motion=selection, motion_prior=prior))

    assert asks(PAPER) == (False, False)
    assert asks(of(motion=True, prior=0.0, ease=1.0)) == (True, False)
    assert asks(of(motion=True, prior=0.0, ease=0.5)) == (True, True)
    assert asks(of(motion=False, prior=0.0, ease=0.5)) == (False, False)
    assert asks(of(motion=False, prior=0.5, ease=1.0)) == (False, True)


@pytest.mark.parametrize("environment", [False, True])
def test_a_fit_that_is_there_is_taken_for_frame_0(environment: bool) -> None:
    there = FitResult(random_scene(60, cameras=4, seed=9), iterations=7, train_psnr=30.0)
    config = replace(COMPACT, environment=replace(COMPACT.environment, enabled=environment))
    method = StructGStream(config, lambda: there)
    found = method.first(task(method))
    assert found.iterations == 7
    assert torch.equal(found.scene.anchors.features, there.scene.anchors.features)
    assert (found.scene.environment is not None) == environment


def test_the_first_frame_of_another_period_is_fitted() -> None:
    def refused() -> FitResult[Scene]:
        raise AssertionError("A fit of frame 0 was taken for a later frame.")

    initial = replace(COMPACT.initial, iterations=2, schedule_iterations=2, coarse_iterations=0)
    method = StructGStream(replace(COMPACT, initial=initial), refused)
    assert method.first(task(method, begins="the light")).iterations == 2


def test_a_target_rate_needs_a_codec_with_rate_control() -> None:
    def aimed(config: StreamConfig) -> StreamConfig:
        return replace(config, rate=replace(config.rate, target_mbits=1.0))

    assert stream_pipeline(aimed(COMPACT)).rate.target_mbits == 1.0
    with pytest.raises(ConfigError, match=r"1 Mbit/s .* 'raw', which has no rate control; take --preset compact"):
        stream_pipeline(aimed(PAPER))
