# SPDX-License-Identifier: Apache-2.0
"""A stream with codec ``compact`` of a world in which everything is known."""

from dataclasses import replace
from functools import cache, partial
from pathlib import Path

import numpy as np
import pytest
import torch

from structgstream.codec.container.records import scan_records
from structgstream.codec.reader import StreamReader
from structgstream.codec.sinks import MemorySink
from structgstream.scene.order import morton_order
from structgstream.scene.scene import Scene
from structgstream.scene.state import parameters_of, state_of
from structgstream.session import struct_gstream as method
from structgstream.session.loop import FrameReport
from structgstream.session.presets import StreamConfig
from structgstream.session.rate_control import RateConfig
from structgstream.training.frame0.seeding import EnvironmentConfig
from structgstream.training.online.config import MotionConfig
from structgstream.training.parameters import RoundingConfig, pixel_size
from tests.support.memory_captures import MemoryCapture
from tests.support.sessions import resume_in, run_session
from tests.support.small_presets import TINY_RIG
from tests.support.streams import same
from tests.support.varied import varied
from tests.support.worlds import moving_world

FRAMES = 4
WORLD = moving_world(FRAMES, speed=0.06, movers=20, emerges_at=1)
CONFIG = replace(
    TINY_RIG,
    codec="compact",
    key_interval_seconds=2 / 30,
    initial=replace(
        TINY_RIG.initial, iterations=20, schedule_iterations=20, coarse_iterations=10, random_background=True
    ),
    environment=EnvironmentConfig(enabled=True),
    online=replace(
        TINY_RIG.online,
        iterations=8,
        patching=replace(TINY_RIG.online.patching, iteration=4),
        motion=varied(MotionConfig(enabled=True, picture_scale=1.0), REACH_PIXELS=1),
        motion_prior=0.5,
        # Eight iterations in pictures of 48 pixels do not carry an anchor further than half a common step.
        rounding=varied(RoundingConfig(), POSITION_PIXELS=0.02),
    ),
)


def run(sink, *, config: StreamConfig = CONFIG, resumed=None, frames: int = FRAMES) -> list[FrameReport]:
    capture = MemoryCapture(WORLD.rig, WORLD.frames[:frames], points=WORLD.scene.anchors.positions.numpy())
    return run_session(capture, sink, config, resumed=resumed)


@cache
def whole() -> tuple[bytes, list[FrameReport], list[Scene], list[Scene]]:
    """The stream, the reports, where each later frame's fit started, and what it came to."""
    started, fitted, fit = [], [], method.fit_next_frame

    def following(scene, *arguments, **options):
        started.append(scene)
        found = fit(scene, *arguments, **options)
        fitted.append(found.scene)
        return found

    method.fit_next_frame = following  # type: ignore[assignment]
    try:
        reports = run(sink := MemorySink())
    finally:
        method.fit_next_frame = fit
    return sink.data, reports, started, fitted


def test_each_frame_starts_from_what_a_reader_sees_and_ends_there() -> None:
    data, reports, started, fitted = whole()
    reader = StreamReader(data)
    scenes = [scene for _, scene in reader.scenes()]
    assert [info.kind.name for info in reader.packets] == ["KEY", "DELTA", "KEY", "DELTA"]
    assert all(same(a, b) for a, b in zip(started, scenes[:-1], strict=True))
    # What was drawn at the end of a fit is already what is sent: the codec loses nothing any more.
    for trained, seen in zip(fitted, scenes[1:], strict=True):
        state = state_of(trained)
        for name in reader.header.dynamic:
            assert torch.equal(state[name].cpu(), state_of(seen)[name]), name
    assert [r.free for r in reports] == [len(scene.free) for scene in scenes]
    assert max(r.free for r in reports) > 0, "the ball that emerges is patched"


def test_steps_come_from_a_pixel() -> None:
    header = StreamReader(whole()[0]).header
    assert header.steps.keys() == {p.name for p in parameters_of(CONFIG.online.dynamic) if p.step}
    rig = header.similarity.rig(header.rig)
    pixel = pixel_size(header.reference["anchor_positions"], [rig[name] for name in rig.training])
    assert pixel is not None
    assert header.steps["anchor_positions"] == pytest.approx(0.02 * pixel, rel=1e-2)


def test_anchors_stand_on_their_grid_in_space_order() -> None:
    header = StreamReader(whole()[0]).header
    positions, step = header.reference["anchor_positions"], header.init_steps["anchor_positions"]
    assert step == float(np.float32(CONFIG.initial.voxel_size))
    assert torch.equal(morton_order(positions, step=step), torch.arange(len(positions)))
    assert torch.equal((positions.double() / step).round().float() * step, positions)


def test_an_environment_is_in_the_header_and_in_every_scene() -> None:
    reader = StreamReader(whole()[0])
    coefficients = reader.header.static["environment"]
    assert coefficients.shape == (9, 3)
    assert torch.equal(coefficients, (coefficients * 256).round() / 256)
    for _, scene in reader.scenes():
        assert scene.environment is not None
        assert torch.equal(scene.environment, coefficients)
    run(sink := MemorySink(), config=replace(CONFIG, environment=EnvironmentConfig()), frames=1)
    assert StreamReader(sink.data).scene(0).environment is None


def test_a_target_rate_is_kept_to_and_resumes_as_it_was(tmp_path: Path) -> None:
    """The target is half of what frame 2 takes without one; the rate scale after it is a matter of record."""
    free = whole()[1]
    config = replace(
        CONFIG,
        rate=varied(RateConfig(free[2].bytes * 8 * MemoryCapture.fps / 2e6), WINDOW_SECONDS=2 / MemoryCapture.fps),
    )
    sink = MemorySink()
    reports = run(sink, config=config)
    assert [r.bytes for r in reports[:2]] == [r.bytes for r in free[:2]]
    assert reports[3].bytes < free[3].bytes
    path = tmp_path / "a.sgs"
    resume_in(path, sink.data[: [*scan_records(sink.data)][-3].end], partial(run, config=config))
    assert path.read_bytes() == sink.data


def delta_bytes(rate_weight: float) -> int:
    online = replace(CONFIG.online, rounding=replace(CONFIG.online.rounding, rate_weight=rate_weight))
    reports = run(MemorySink(), config=replace(CONFIG, online=online, key_interval_seconds=1.0), frames=2)
    return sum(report.field_bytes[name] for report in reports[1:] for name in ("anchor_positions", "offset_scales"))


def test_a_higher_price_makes_fewer_bytes() -> None:
    """Up to a price of 1 here: from there on no anchor moves any more, and what is left are heads of blocks."""
    sizes = [delta_bytes(weight) for weight in (0.0, 1e-2, 1.0)]
    assert sizes[0] > 1.4 * sizes[1] > 2.0 * sizes[2]
    assert sizes[2] == 17


def test_without_a_look_at_motion_everything_moves_f_sigma_too() -> None:
    online = replace(
        CONFIG.online, motion=MotionConfig(), rounding=varied(RoundingConfig(), POSITION_PIXELS=0.02, WEIGHT_STEP=1e-4)
    )
    run(sink := MemorySink(), config=replace(CONFIG, online=online), frames=2)
    reader = StreamReader(sink.data)
    assert "covariance_mlp" in reader.header.reference
    states = [state_of(scene) for _, scene in reader.scenes()]
    assert not torch.equal(states[0]["covariance_mlp"], states[1]["covariance_mlp"])
    assert same(reader.scene(1), StreamReader(sink.data).scene(1))
