# SPDX-License-Identifier: Apache-2.0
"""A small moving world as a capture, and methods that finish on it in a second."""

from dataclasses import dataclass, field
from typing import Any

from structgstream.training.result import FitResult
from structgstream_studies.peers.methods import AnyMethod
from tests.support.memory_captures import MemoryCapture
from tests.support.worlds import moving_world


def moving_capture(frames: int = 3, *, speed: float = 0.03) -> MemoryCapture:
    """The world of ``worlds.moving_world``, with points where its anchors are in frame 0."""
    world = moving_world(frames, speed=speed)
    points = world.scene.anchors.positions.double().numpy()
    return MemoryCapture(world.rig, world.frames, name="moving world", points=points)


@dataclass
class Watched:
    """A method that remembers what it fitted."""

    method: AnyMethod
    fits: list[FitResult[Any]] = field(default_factory=list)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.method, name)

    def first(self, *args: Any, **kwargs: Any) -> FitResult[Any]:
        self.fits.append(self.method.first(*args, **kwargs))
        return self.fits[-1]

    def next(self, *args: Any, **kwargs: Any) -> FitResult[Any]:
        self.fits.append(self.method.next(*args, **kwargs))
        return self.fits[-1]
