# SPDX-License-Identifier: Apache-2.0
"""A disk that is nearly full: stopping while there is room to finish is better than failing in the middle."""

import shutil
from pathlib import Path

from structgstream.errors import StorageError

MARGIN_PACKETS = 3
"""A packet is written only while this many of the largest one so far fit, besides what closing the stream takes."""


def free_bytes(path: Path) -> int | None:
    """What an ordinary user may still write beside ``path``; None if that is not known."""
    try:
        return shutil.disk_usage(path).free
    except OSError:
        return None


def check_room(free: int | None, *, largest: int, closing: int, where: str, frames: int) -> None:
    """Check that the next packet and the end of the stream fit.

    Args:
        free: bytes that are left; None if that is not known.
        largest: bytes of the largest packet so far, the next one included.
        closing: bytes that closing the stream takes.
        where: the stream, for the message.
        frames: number of frames that it has.

    Raises:
        StorageError: they may not fit.
    """
    needed = MARGIN_PACKETS * largest + closing
    if free is not None and free < needed:
        raise StorageError(
            f"The disk of {where} is nearly full: {free} bytes are left, and {needed} are kept to finish the stream. "
            f"It was closed after {frames} frames, all of which are safe; make room and continue with --resume."
        )
