# SPDX-License-Identifier: Apache-2.0
"""What a peer is: another method's way from pictures to a frame, behind this project's loop."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Generic, Protocol, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from structgstream.cameras import CameraRig
from structgstream.frames import MultiViewFrame
from structgstream.kernels.backend import Backend
from structgstream.scene.render import Drawable
from structgstream.training.result import StepListener

Arrays = dict[str, NDArray[Any]]
"""A frame's fields by name, as they are stored: float16, float32, uint8 or int64."""


PointsMaker = Callable[[], Tensor]
"""Gives initial points ``[P, 3]`` of a frame in normalised units; making them may take a while."""

State = TypeVar("State", bound=Drawable)
State_co = TypeVar("State_co", bound=Drawable, covariant=True)
Memory = TypeVar("Memory")


@dataclass(frozen=True)
class PeerFit(Generic[State_co]):
    """A fitted frame.

    Args:
        state: what was fitted, before it was coded.
        train_psnr: mean over training cameras of the PSNR of the last rendering of each during optimisation, dB.
        seconds: wall-clock seconds by stage.
        spawned: Gaussians added in this frame.
        pruned: Gaussians removed in this frame.
    """

    state: State_co
    train_psnr: float
    seconds: Mapping[str, float] = field(default_factory=dict)
    spawned: int = 0
    pruned: int = 0


class PeerMethod(Protocol[State, Memory]):
    """A method behind the loop. Its state is what a receiver holds; the next frame starts from the decoded one.

    ``Memory`` is what the encoder alone keeps from frame to frame; it is made from the decoded frame 0 and the seed,
    so that a resumed run has the same.
    """

    @property
    def name(self) -> str:
        """What the header's ``codec`` says."""
        ...

    @property
    def stands_alone(self) -> bool:
        """Whether every frame can be shown without those before it."""
        ...

    @property
    def config(self) -> Any:
        """Everything that decides the result, as a dataclass: the header's ``config``."""
        ...

    def first(
        self,
        frame: MultiViewFrame,
        rig: CameraRig,
        points: PointsMaker,
        *,
        backend: Backend,
        seed: int,
        on_step: StepListener | None = None,
    ) -> PeerFit[State]:
        """Fit frame 0; everything in normalised units."""
        ...

    def prepared(self, state: State, *, backend: Backend, seed: int) -> Memory:
        """What the encoder needs for later frames, from the decoded frame 0."""
        ...

    def next(
        self,
        state: State,
        memory: Memory,
        frame: MultiViewFrame,
        rig: CameraRig,
        points: PointsMaker,
        *,
        backend: Backend,
        seed: int,
        on_step: StepListener | None = None,
    ) -> PeerFit[State]:
        """Fit a later frame, from the decoded one before it. ``points`` are this frame's."""
        ...

    def arrays(self, state: State) -> Arrays:
        """What a receiver who holds the frame before needs to show this one."""
        ...

    def restored(self, arrays: Mapping[str, NDArray[Any]], previous: State | None, *, device: torch.device) -> State:
        """The decoder: the state of a frame, exactly the same at the trainer and at the receiver.

        Raises:
            StreamError: the arrays are not those of this method, or the frame needs one before it.
        """
        ...


def stored(value: Tensor, dtype: torch.dtype = torch.float32) -> NDArray[Any]:
    """A tensor as an array to store."""
    return np.ascontiguousarray(value.detach().to("cpu", dtype).numpy())
