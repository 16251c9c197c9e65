# SPDX-License-Identifier: Apache-2.0
"""The pictures that a stream was made from."""

from pathlib import Path

from structgstream.codec.packets import StreamHeader
from structgstream.data.open import open_capture
from structgstream.data.source import FrameSource
from structgstream.data.wrappers import resized, section


def capture_of(header: StreamHeader, folder: Path | str, *, frames: int | None) -> FrameSource:
    """The part of the capture in ``folder`` that a stream was made from, at the stream's sizes.

    Args:
        header: the stream's.
        folder: the capture's.
        frames: how many the stream has; None for all that the capture has from its first on.

    Raises:
        CaptureError: the folder holds no capture, or less than the stream begins with.
    """
    start = int(header.metadata.get("start", 0))
    whole = open_capture(folder)
    shared = [name for name in header.rig if name in whole.rig.cameras]
    scale = header.rig[shared[0]].width / whole.rig[shared[0]].width if shared else 1.0
    left = len(whole) - start
    wanted = left if frames is None else min(frames, left)
    return section(resized(whole, min(scale, 1.0)), start=start, frames=wanted)
