# SPDX-License-Identifier: Apache-2.0
"""How a stream begins: where points come from, and what the header says of the scene that goes on."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from memory_captures import MemoryCapture
from rigs import random_scene
from small_presets import TINY_RIG
from streams import same
from structgstream import beginning
from structgstream.beginning import begun, frame_seed, initial_points_of
from structgstream.codec.packets import StreamHeader
from structgstream.data.points import PointsConfig
from structgstream.kernels.backend import reference_backend
from structgstream.presets import TINY, StreamConfig, to_json
from structgstream.scene.scene import Scene
from structgstream.scene.state import state_of
from structgstream.similarity import Similarity
from worlds import moving_world

WORLD = moving_world(1, cameras=4)
SIMILARITY = Similarity((0.0, 0.1, 0.0), 2.0)


def source(points: np.ndarray | None = None) -> MemoryCapture:
    return MemoryCapture(WORLD.rig, WORLD.frames, fps=25.0, points=points)


def begin(config: StreamConfig, scene: Scene) -> tuple[Scene, StreamHeader]:
    return begun(
        scene,
        source(),
        frame=WORLD.frames[0],
        config=config,
        metadata={"capture": "world"},
        similarity=SIMILARITY,
        backend=reference_backend(),
    )


def test_seeds_of_frames_and_of_streams_are_apart() -> None:
    assert frame_seed(0, 7) == 7
    assert frame_seed(2, 7) == 2_000_013
    assert frame_seed(-1, 0) == 2**63 - 1_000_003, "never negative"


def test_points_of_the_capture_are_taken_and_normalised(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []

    def found(frame, rig, *, config, seed):
        asked.append(seed)
        return type("Points", (), {"positions": np.ones((4, 3))})

    monkeypatch.setattr(beginning, "initial_points", found)
    given = np.array([[0.0, 0.1, 0.0], [1.0, 0.1, -1.0]])
    options = {"config": PointsConfig(), "seed": 5, "similarity": SIMILARITY}
    points = initial_points_of(source(given), WORLD.frames[0], **options)
    torch.testing.assert_close(points.double(), torch.tensor([[0.0, 0.0, 0.0], [2.0, 0.0, -2.0]]).double())
    assert not asked
    points = initial_points_of(source(), WORLD.frames[0], **options)
    torch.testing.assert_close(points.double(), torch.tensor([[2.0, 1.8, 2.0]]).double().expand(4, 3))
    assert asked == [5]


def test_a_raw_stream_goes_on_with_the_scene_as_it_is() -> None:
    scene = random_scene(20, seed=2)
    found, header = begin(TINY_RIG, scene)
    assert same(found, scene)
    state = state_of(scene)
    assert header.static.keys() == state.keys() - TINY_RIG.online.dynamic
    assert all(torch.equal(value, state[name]) for name, value in header.static.items())
    assert (header.codec, header.fps, header.rig, header.similarity) == ("raw", 25.0, WORLD.rig, SIMILARITY)
    assert not header.steps
    assert not header.reference
    assert not header.init_steps
    assert header.config == to_json(TINY_RIG)


def test_a_compact_stream_goes_on_with_numbers_on_their_bins() -> None:
    """Every number is a whole number of its step, and the header's reference is what goes on."""
    config = replace(TINY, environment=replace(TINY.environment, enabled=False))
    scene = random_scene(20, seed=2)
    found, header = begin(config, scene)
    assert len(found.anchors) == 20
    state = state_of(found)
    assert header.reference.keys() == config.online.dynamic - {"free", "free_births"}
    assert all(torch.equal(value, state[name]) for name, value in header.reference.items())
    assert set(header.static) | set(config.online.dynamic) >= state.keys()
    assert header.init_steps
    for name, step in header.init_steps.items():
        bins = state[name].double() / step
        torch.testing.assert_close(bins, bins.round(), atol=1e-3, rtol=0)
    assert all(step == float(np.float32(step)) for step in (*header.steps.values(), *header.init_steps.values()))
    again, its_header = begin(config, scene)
    assert same(again, found)
    assert its_header.init_steps == header.init_steps
