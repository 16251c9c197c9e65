# SPDX-License-Identifier: Apache-2.0
"""The protocol of peers: fitting of frames, and conversion of frames to arrays and back."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Generic, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from structgstream.cameras import CameraRig
from structgstream.frames import MultiViewFrame
from structgstream.kernels.backend import Backend
from structgstream.session.pipeline import FrameTask, Memory, Method, Past, State
from structgstream.training.online.preprocess import FramePictures
from structgstream.training.result import FitResult
from structgstream.training.views import View, training_views

Arrays = dict[str, NDArray[Any]]
"""A frame's fields by name, as they are stored: float16, float32, uint8 or int64."""


class PeerMethod(Method[State, Memory], Protocol[State, Memory]):
    """A method whose frames are stored as named arrays (``container.py``)."""

    @property
    def name(self) -> str:
        """The value of the header's ``codec``."""
        ...

    @property
    def stands_alone(self) -> bool:
        """Whether every frame can be decoded without those before it."""
        ...

    @property
    def config(self) -> Any:
        """The configuration as a dataclass: the header's ``config``."""
        ...

    def arrays(self, state: State) -> Arrays:
        """The arrays that a receiver with the previous frame needs for this one."""
        ...

    def restored(self, arrays: Mapping[str, NDArray[Any]], previous: State | None, *, device: torch.device) -> State:
        """The decoder: the state of a frame, exactly the same at the trainer and at the receiver.

        Raises:
            StreamError: the arrays are not those of this method, or the frame needs one before it.
        """
        ...


class PicturesOnly:
    """Base of peers: they need only the training views, and only one previous frame."""

    needs_before = False
    needs_before_previous = False

    def observe(
        self, frame: MultiViewFrame, before: Sequence[View] | None, *, rig: CameraRig, backend: Backend
    ) -> FramePictures:
        """The training views."""
        return FramePictures(training_views(frame, rig, backend.device), None)


class IndependentFrames(PicturesOnly, ABC, Generic[State]):
    """A method that fits every frame from scratch."""

    stands_alone = True

    @abstractmethod
    def first(self, task: FrameTask) -> FitResult[State]:
        """Any frame."""

    def prepare(self, state: State, task: Callable[[], FrameTask]) -> None:
        """Nothing."""

    def next(self, past: Past[State, None], task: FrameTask) -> FitResult[State]:
        """As :meth:`first`."""
        return self.first(task)


def stored(value: Tensor, dtype: torch.dtype = torch.float32) -> NDArray[Any]:
    """A tensor as an array to store."""
    return np.ascontiguousarray(value.detach().to("cpu", dtype).numpy())
