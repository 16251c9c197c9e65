# SPDX-License-Identifier: Apache-2.0
"""Opens the capture that a stream was made from."""

from pathlib import Path

from structgstream.codec.packets import StreamHeader
from structgstream.data.open import open_capture
from structgstream.data.source import FrameSource
from structgstream.data.wrappers import resized, section


def part_metadata(*, start: int, scale: float, every: int) -> dict[str, object]:
    """Metadata of a header on the part of a capture that a stream is made from; :func:`capture_of` reads it.

    Args:
        start: first frame.
        scale: size of the pictures relative to the stored ones.
        every: step between frames; 1 is left out, because older streams have no step.
    """
    part: dict[str, object] = {"start": start, "scale": scale}
    return part if every == 1 else part | {"every": every}


def capture_of(header: StreamHeader, folder: Path | str, *, frames: int | None) -> FrameSource:
    """The part of the capture in ``folder`` that a stream was made from, at the stream's sizes.

    Args:
        header: header of the stream.
        folder: folder of the capture.
        frames: number of frames of the stream; None for all from the stream's first frame on.

    Raises:
        CaptureError: the folder contains no capture, or the capture ends before the stream's first frame.
    """
    whole = open_capture(folder)
    return _part(resized(whole, _scale(header, whole)), header, frames)


def stored_capture(header: StreamHeader, folder: Path | str, *, frames: int | None) -> FrameSource | None:
    """As :func:`capture_of`, at the size of the stored pictures; None if these are not larger than the stream's.

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
