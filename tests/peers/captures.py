# SPDX-License-Identifier: Apache-2.0
"""A small moving world as a capture, and methods that finish on it in a second."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from structgstream.cameras import CameraRig
from structgstream.frames import MultiViewFrame
from structgstream.peers.methods import AnyMethod
from structgstream.training.result import FitResult
from worlds import moving_world


@dataclass
class Capture:
    """A capture in memory."""

    rig: CameraRig
    pictures: list[MultiViewFrame]
    points: np.ndarray
    fps: float = 30.0
    name: str = "moving world"

    def __len__(self) -> int:
        return len(self.pictures)

    def frames(self, start: int = 0) -> Iterator[MultiViewFrame]:
        yield from self.pictures[start:]


def moving_capture(frames: int = 3, *, speed: float = 0.03) -> Capture:
    """The world of ``worlds.moving_world``, with points where its anchors are in frame 0."""
    world = moving_world(frames, speed=speed)
    return Capture(world.rig, world.frames, world.scene.anchors.positions.double().numpy())


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
