# SPDX-License-Identifier: Apache-2.0
"""The protocol of captures."""

from collections.abc import Iterator
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from structgstream.cameras import CameraRig
from structgstream.frames import MultiViewFrame


class FrameSource(Protocol):
    """A capture: a calibrated rig and its frames, in order.

    ``frames(start)`` may be called again, each time from the given stream index; it opens its own decoders, and the
    pictures it yields have the size the rig states. Cameras without a picture of an instant are absent from its frame,
    whatever the frame that reading starts from. Problems are raised as ``CaptureError``.
    """

    @property
    def rig(self) -> CameraRig: ...

    @property
    def fps(self) -> float: ...

    @property
    def name(self) -> str: ...

    @property
    def points(self) -> NDArray[np.float64] | None:
        """Points ``[P, 3]`` that come with the capture (a COLMAP model), in its units; None without any."""
        ...

    def __len__(self) -> int:
        """Number of frames, from the one in which the last camera begins (``timeline.common_slots``)."""
        ...

    def frames(self, start: int = 0) -> Iterator[MultiViewFrame]: ...
