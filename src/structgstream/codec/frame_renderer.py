# SPDX-License-Identifier: Apache-2.0
"""Renders decoded frames; keeps the last scene, because a frame is often rendered for several cameras."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from structgstream.cameras import Camera
from structgstream.kernels.backend import Backend, BackendName, select_backend
from structgstream.scene.render import render, to_8bit_image
from structgstream.scene.scene import Scene
from structgstream.scene.state import on_device


class FrameRenderer:
    """Renders frames of one stream; keeps the last scene and back-end between calls."""

    def __init__(self) -> None:
        self._asked: BackendName | Backend | None = None
        self._backend: Backend | None = None
        self._last: tuple[int, Scene] | None = None

    def picture(
        self, index: int, view: Camera, *, decode: Callable[[int], Scene], backend: BackendName | Backend
    ) -> NDArray[np.uint8]:
        """The 8-bit sRGB picture ``[H, W, 3]`` of a frame.

        Args:
            index: the frame.
            view: the camera, in the scene's units.
            decode: returns the scene of a frame.
            backend: the compute back-end.

        Raises:
            BackendError: the back-end is not available.
        """
        if self._backend is None or backend != self._asked:
            self._backend, self._asked, self._last = select_backend(backend), backend, None
        if self._last is None or self._last[0] != index:
            self._last = None  # So that two scenes are not in memory at once.
            self._last = index, on_device(decode(index), self._backend.device)
        return to_8bit_image(render(self._last[1], view, self._backend).image)
