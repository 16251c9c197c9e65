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
class ArrivingFrames(Protocol):
    """What a stream adds whose frames arrive while it is read; it has no length."""

    @property
    def newest_only(self) -> bool:
        """Whether a frame is the newest when it is asked for, so that one that is asked for early is old when used."""
        ...


@runtime_checkable
class TimedPictures(Protocol):
    """What a recording adds that knows when its pictures were taken."""

    @property
    def apart_seconds(self) -> Mapping[str, NDArray[np.float64]]:
        """Camera name to how long after its instant its picture of each frame was taken, ``[N]``; NaN where it has
        none; empty where that is not known."""
        ...


@runtime_checkable
class KeepsFrames(Protocol):
    """What a stream adds that can hand out only those of its older frames again which it was told to keep."""

    def keep(self, *first: int, last: int) -> None:
        """Keep the frames ``first``, and at any time the ``last`` frames handed out; others may go."""
        ...


def keep_frames(source: FrameStream, *first: int, last: int) -> None:
    """Ask for what a resumed run reads again, which recordings have anyway."""
    if isinstance(source, KeepsFrames):
        source.keep(*first, last=last)


def is_recording(source: FrameStream) -> TypeGuard[FrameSource]:
    """Whether the number of frames is known."""
    return isinstance(source, Sized)


def frame_count(source: FrameStream) -> int | None:
    """Number of frames; None where it is unknown before the end."""
    return len(source) if is_recording(source) else None


def may_read_ahead(source: FrameStream) -> bool:
    """Whether the next frame may be read while one is fitted, which changes no frame of a recording."""
    return not (isinstance(source, ArrivingFrames) and source.newest_only)
