# SPDX-License-Identifier: Apache-2.0
"""What is true of the field ``brightness`` once the diff of CONTRIBUTING.md is applied; another process runs it."""

from typing import Any, cast

import torch

import structgstream
from structgstream.codec.reader import StreamReader
from structgstream.codec.sinks import MemorySink
from structgstream.kernels.backend import reference_backend
from structgstream.scene.render import draw
from structgstream.scene.scene import Scene
from structgstream.scene.state import PAPER_DYNAMIC, state_of, with_dynamic_fields
from structgstream.training.online.config import OnlineConfig, online_rates
from structgstream.training.online.select import changed_primitives
from structgstream.training.optim import Adam
from structgstream.training.parameters import Parameters, RoundingConfig, detached, parameters_of_fields
from tests.support.rigs import arc_rig, random_scene
from tests.support.streams import STEPS, compact_header, header_for, same, write_stream

NAME = cast(Any, "brightness")
DYNAMIC = PAPER_DYNAMIC | {NAME}


def check() -> None:
    """Prints where the package lies that was looked at.

    Raises:
        AssertionError: something is not true.
    """
    plain = random_scene(40, free=3)
    assert NAME not in state_of(plain)
    scene = with_dynamic_fields(plain, DYNAMIC)
    assert state_of(scene)[NAME].tolist() == [[0.0]] * 40
    trained = fitted(scene)
    assert changed_primitives(scene, trained)[:40].any()
    camera, backend = arc_rig()["cam00"], reference_backend()
    (of_views,) = trained.gaussians_of_views([camera], backend)
    assert torch.equal(of_views.colors, trained.gaussians(camera, backend).colors), "measuring sees what render draws"
    frames = [scene, trained, fitted(trained)]
    for header in (header_for(scene, dynamic=DYNAMIC), compact_header(scene, dynamic=DYNAMIC)):
        sink = MemorySink()
        seen = write_stream(sink, frames, header=header)
        read = [found for _, found in StreamReader(sink.data).scenes()]
        assert all(same(one, other) for one, other in zip(read, seen, strict=True))
        off = [(state_of(one)[NAME] - state_of(other)[NAME]).abs().max() for one, other in zip(seen, frames)]
        assert max(off) <= (0.0 if header.codec == "raw" else 0.5001 * STEPS[NAME])
        assert state_of(seen[2])[NAME].abs().max() > 0.0
    print(structgstream.__file__)


def fitted(scene: Scene) -> Scene:
    """``scene`` after a step towards brighter pictures, of the field alone."""
    backend = reference_backend()
    steps: dict[Any, float] = {NAME: RoundingConfig().steps(0.01)[NAME]}
    parameters = Parameters.of(scene, trained=parameters_of_fields({NAME}), steps=steps)
    assert [name for name, value in parameters.values.items() if value.requires_grad] == [NAME]
    drawn, camera = parameters.scene(scene), arc_rig()["cam00"]
    image = draw(drawn.gaussians(camera, backend), camera, backend).image
    (gradient,) = torch.autograd.grad(-image.sum(), [parameters.values[NAME]])
    Adam(backend, parameters.values).step({NAME: gradient}, online_rates(OnlineConfig(), 0.0))
    return detached(parameters.scene(scene))
