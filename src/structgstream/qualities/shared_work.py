# SPDX-License-Identifier: Apache-2.0
"""Computes once what all qualities of a stream have in common: pictures, their changes, first frames.

Note [Shared work]
~~~~~~~~~~~~~~~~~~
Qualities differ in quantization steps and in the weight of the rate term. Neither affects the preprocessing of
pictures, nor the fit of frame 0 (or of a period that begins from points), which is quantized only afterwards. So each
of these is computed for the first quality that requests it, and the others receive the same values; their bytes equal
those of separate runs. Qualities fit a frame one after the other, so only the latest results are cached.
"""

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable
from concurrent.futures import Future
from dataclasses import dataclass, field, replace
from typing import Any, Generic, TypeVar

from structgstream.cameras import CameraRig
from structgstream.frames import MultiViewFrame
from structgstream.kernels.backend import Backend
from structgstream.scene.scene import Scene
from structgstream.session.pipeline import FrameTask, Past, Pipeline
from structgstream.session.presets import StreamConfig
from structgstream.session.struct_gstream import FrameZeroContext, StructGStream, stream_pipeline
from structgstream.training.online.preprocess import FramePictures
from structgstream.training.result import FitResult

Value = TypeVar("Value")
PICTURES_KEPT = 3
"""Results of the current frame, the next one, which may be read ahead, and the previous one, if a quality lacks it."""


class Once(Generic[Value]):
    """A cache that computes each value at its first request; concurrent requests wait for it. Thread-safe.

    Args:
        most: largest number of cached values.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._found: OrderedDict[Hashable, Future[Value]] = OrderedDict()
        self._lock = threading.Lock()

    def value(self, key: Hashable, make: Callable[[], Value]) -> tuple[Value, bool]:
        """The value of ``key``, and whether it was computed now. All waiting requests receive an error of ``make``."""
        with self._lock:
            found = self._found.get(key)
            mine = found is None
            if found is None:
                found = self._found[key] = Future()
                while len(self._found) > self._most:
                    self._found.popitem(last=False)
        if mine:
            try:
                found.set_result(make())
            except BaseException as error:
                found.set_exception(error)
                self._forget(key)
        return found.result(), mine

    def clear(self) -> None:
        """Removes all values."""
        with self._lock:
            self._found.clear()

    def _forget(self, key: Hashable) -> None:
        with self._lock:
            self._found.pop(key, None)


@dataclass(frozen=True)
class SharedWork:
    """Shared results of the qualities of one run.

    Args:
        pictures: preprocessed pictures, by the numbers of a frame and of the frame before.
        first: fits of first frames, by frame number.
    """

    pictures: Once[FramePictures] = field(default_factory=lambda: Once(PICTURES_KEPT))
    first: Once[FitResult[Scene]] = field(default_factory=lambda: Once(1))


@dataclass(frozen=True)
class SharedMethod(StructGStream):
    """The method of one of several qualities (Note [Shared work]).

    Args:
        shared: the shared results.
    """

    shared: SharedWork = field(default_factory=SharedWork)

    def observe(
        self, frame: MultiViewFrame, before: MultiViewFrame | None, *, rig: CameraRig, backend: Backend
    ) -> FramePictures:
        """See ``StructGStream``."""
        key = frame.index, None if before is None else before.index
        observe = super().observe
        return self.shared.pictures.value(key, lambda: observe(frame, before, rig=rig, backend=backend))[0]

    def first(self, task: FrameTask) -> FitResult[Scene]:
        """See ``StructGStream``; only the quality that computed the fit reports its seconds."""
        first = super().first
        fit, mine = self.shared.first.value(task.frame.index, lambda: first(task))
        return fit if mine else replace(fit, seconds={})

    def next(self, past: Past[Scene, FrameZeroContext], task: FrameTask) -> FitResult[Scene]:
        """See ``StructGStream``."""
        if task.begins is None:  # All qualities have the previous frame, so no first frame is needed again.
            self.shared.first.clear()
        return super().next(past, task)


def shared_pipeline(config: StreamConfig, shared: SharedWork) -> Pipeline[Scene, Any]:
    """The pipeline of one of several qualities.

    Raises:
        ConfigError: see ``stream_pipeline``.
    """
    return replace(stream_pipeline(config), method=SharedMethod(config, shared=shared))
