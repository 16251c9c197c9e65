# SPDX-License-Identifier: Apache-2.0
"""The pictures that a stream was made from."""

from pathlib import Path

from structgstream.codec.packets import StreamHeader
from structgstream.data.open import open_capture
from structgstream.data.source import FrameSource
from structgstream.data.wrappers import resized, section


def part_metadata(*, start: int, scale: float, every: int) -> dict[str, object]:
    """What a header says of the part of a capture that a stream is made from, which :func:`capture_of` reads.

    Args:
        start: first frame.
        scale: size of the pictures relative to the stored ones.
        every: step between frames; 1 is left out, as streams from before there were steps have none.
    """
    part: dict[str, object] = {"start": start, "scale": scale}
    return part if every == 1 else part | {"every": every}


def capture_of(header: StreamHeader, folder: Path | str, *, frames: int | None) -> FrameSource:
    """The part of the capture in ``folder`` that a stream was made from, at the stream's sizes.

    Args:
        header: the stream's.
        folder: the capture's.
        frames: how many the stream has; None for all that the capture has from its first on.

    Raises:
        CaptureError: the folder holds no capture, or less than the stream begins with.
    """
    whole = open_capture(folder)
    return _part(resized(whole, _scale(header, whole)), header, frames)


def stored_capture(header: StreamHeader, folder: Path | str, *, frames: int | None) -> FrameSource | None:
    """As :func:`capture_of`, at the size of the stored pictures; None where these are not larger than the stream's.

    Raises:
        CaptureError: see :func:`capture_of`.
    """
    whole = open_capture(folder)
    return _part(whole, header, frames) if _scale(header, whole) < 1.0 else None


def _scale(header: StreamHeader, whole: FrameSource) -> float:
    shared = [name for name in header.rig if name in whole.rig.cameras]
    return min(header.rig[shared[0]].width / whole.rig[shared[0]].width, 1.0) if shared else 1.0


def _part(source: FrameSource, header: StreamHeader, frames: int | None) -> FrameSource:
    start, every = int(header.metadata.get("start", 0)), int(header.metadata.get("every", 1))
    left = -(-(len(source) - start) // every)
    return section(source, start=start, frames=left if frames is None else min(frames, left), every=every)
