# SPDX-License-Identifier: Apache-2.0
"""How a stream of scenes begins: what its header says of the scene that later frames start from."""

from dataclasses import replace

import numpy as np
import torch

from structgstream.cameras import Similarity
from structgstream.codec.packets import StreamHeader
from structgstream.kernels.backend import reference_backend
from structgstream.scene.scene import Scene
from structgstream.scene.state import state_of
from structgstream.session.loop import frame_seed
from structgstream.session.pipeline import FrameTask, StreamFacts
from structgstream.session.presets import TINY, StreamConfig, to_json
from structgstream.session.struct_gstream import SceneCodec
from structgstream.training.online.preprocess import FramePictures
from structgstream.training.views import training_views
from tests.support.rigs import random_scene
from tests.support.small_presets import TINY_RIG
from tests.support.streams import same
from tests.support.worlds import moving_world

WORLD = moving_world(1, cameras=4)
SIMILARITY = Similarity((0.0, 0.1, 0.0), 2.0)


def begin(config: StreamConfig, scene: Scene) -> tuple[Scene, StreamHeader]:
    rig = SIMILARITY.rig(WORLD.rig)
    frame = WORLD.frames[0]
    task = FrameTask(
        frame=frame,
        pictures=FramePictures(training_views(frame, rig, torch.device("cpu")), changes=None),
        rig=rig,
        points=lambda: torch.zeros(0, 3),
        backend=reference_backend(),
        seed=frame_seed(config.seed, 0),
    )
    codec = SceneCodec(config)
    facts = StreamFacts(codec.name, WORLD.rig, SIMILARITY, 25.0, to_json(config), {"capture": "world"})
    return codec.prepare(scene, task, facts)


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
