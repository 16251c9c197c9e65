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
    return {"start": start, "scale": scale} | ({} if every == 1 else {"every": every})


def capture_of(header: StreamHeader, folder: Path | str, *, frames: int | None) -> FrameSource:
    """The part of the capture in ``folder`` that a stream was made from, at the stream's sizes.

    Args:
        header: the stream's.
        folder: the capture's.
        frames: how many the stream has; None for all that the capture has from its first on.

    Raises:
        CaptureError: the folder holds no capture, or less than the stream begins with.
    """
    start, every = int(header.metadata.get("start", 0)), int(header.metadata.get("every", 1))
    whole = open_capture(folder)
    shared = [name for name in header.rig if name in whole.rig.cameras]
    scale = header.rig[shared[0]].width / whole.rig[shared[0]].width if shared else 1.0
    left = -(-(len(whole) - start) // every)
    wanted = left if frames is None else min(frames, left)
    return section(resized(whole, min(scale, 1.0)), start=start, frames=wanted, every=every)
