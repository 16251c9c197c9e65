# SPDX-License-Identifier: Apache-2.0
"""The protocols of captures: recordings, whose length is known, and streams that are still being filmed."""

from collections.abc import Iterator, Mapping, Sized
from typing import Protocol, TypeGuard, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from structgstream.cameras import CameraRig
from structgstream.frames import MultiViewFrame


class FrameStream(Protocol):
    """A calibrated rig and its frames, in order; how many there will be may be unknown.

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

    def frames(self, start: int = 0) -> Iterator[MultiViewFrame]: ...


class FrameSource(FrameStream, Protocol):
    """A recording: a stream of frames whose number is known."""

    def __len__(self) -> int:
        """Number of frames, from the one in which the last camera begins (``timeline.common_slots``)."""
        ...


@runtime_checkable
class TimedPictures(Protocol):
    """A recording that knows when its pictures were taken."""

    @property
    def apart_seconds(self) -> Mapping[str, NDArray[np.float64]]:
        """Camera name to how long after its instant its picture of each frame was taken, ``[N]``; NaN where it has
        none; empty where that is not known."""
        ...


@runtime_checkable
class RetainsFrames(Protocol):
    """A live stream that stores earlier frames, so that a resumed run can read them again."""

    def retain(self, *first: int, last: int) -> None:
        """Retains the frames ``first``, and at any time the ``last`` frames delivered; others may be removed."""
        ...


def retain_frames(source: FrameStream, *first: int, last: int) -> None:
    """Retains the frames that a resumed run reads again; recordings have all of them."""
    if isinstance(source, RetainsFrames):
        source.retain(*first, last=last)


def is_recording(source: FrameStream) -> TypeGuard[FrameSource]:
    """Whether the number of frames is known. Other streams drop stale frames, and must not be prefetched."""
    return isinstance(source, Sized)


def frame_count(source: FrameStream) -> int | None:
    """Number of frames; None if it is unknown before the end."""
    return len(source) if is_recording(source) else None
