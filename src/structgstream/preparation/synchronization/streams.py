# SPDX-License-Identifier: Apache-2.0
"""What synchronisation needs of the cameras' files."""

from collections.abc import Iterator, Mapping
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray


class Streams(Protocol):
    """The files of each camera as filmed. Names of cameras are arguments of every function."""

    @property
    def cameras(self) -> tuple[str, ...]: ...

    def stamps(self, name: str, /) -> NDArray[np.float64]:
        """Seconds ``[T]`` of every frame by the camera's own clock, ascending."""
        ...

    def pictures(self, name: str, indices: NDArray[np.intp], /) -> Iterator[NDArray[np.uint8]]:
        """The pictures ``[H, W, 3]`` sRGB of these frames (ascending), one after another."""
        ...

    def audio(self, name: str, /) -> tuple[NDArray[np.float32], float] | None:
        """Mono samples ``[N]`` and their rate in hertz, the first sample at the second 0 of :meth:`stamps`; None
        without sound."""
        ...

    def size(self, name: str, /) -> tuple[int, int]:
        """Width and height of the pictures, pixels."""
        ...


@runtime_checkable
class StatesMetadata(Protocol):
    """Streams whose files state when they were made."""

    def metadata(self, name: str, /) -> Mapping[str, str]:
        """What the file states as text, by lower-case key: ``creation_time``, ``timecode``."""
        ...


def period_seconds(stamps: NDArray[np.float64]) -> float:
    """The usual time between two frames; 1/30 s for a single one."""
    return float(np.median(np.diff(stamps))) if len(stamps) > 1 else 1 / 30
