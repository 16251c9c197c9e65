# SPDX-License-Identifier: Apache-2.0
"""Whose folder a capture is: one of other videos, made by hand, or in another process's hands is not written into."""

import fcntl
import json
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from structgstream.errors import CaptureError, StorageError
from structgstream.preparation.steps import FOLDER

SOURCE = "source.json"
LOCK = ".preparing"


def claim(capture: Path, videos: Path) -> None:
    """Marks ``capture`` as the one of these videos.

    Raises:
        CaptureError: it is something else's folder.
        StorageError: it cannot be written.
    """
    marker = capture / FOLDER / SOURCE
    origin = str(videos.resolve())
    if capture.resolve() == videos.resolve():
        raise CaptureError(f"The capture cannot be the folder of the videos itself, {videos}; choose another with -o.")
    if capture.exists() and not capture.is_dir():
        raise CaptureError(f"{capture} is a file; choose a folder with -o.")
    if marker.is_file():
        before = _origin(marker)
        if before != origin:
            raise CaptureError(
                f"{capture} was prepared from {before}, not from {origin}; choose another folder with -o, or remove it."
            )
        return
    if capture.exists() and any(capture.iterdir()):
        raise CaptureError(
            f"The folder {capture} is not empty and was not made by prepare; choose another with -o, or empty it."
        )
    part = marker.with_suffix(".part")
    try:
        marker.parent.mkdir(parents=True, exist_ok=True)
        part.write_text(json.dumps({"videos": origin}) + "\n")
        os.replace(part, marker)
    except OSError as error:
        with suppress(OSError):  # so that the folder is empty as before, when there is room again
            part.unlink(missing_ok=True)
            marker.parent.rmdir()
        raise StorageError(f"The folder {capture} cannot be written ({error.strerror}).") from None


@contextmanager
def alone(capture: Path) -> Iterator[None]:
    """No other process prepares the same capture within the block.

    Args:
        capture: its folder, which was claimed.

    Raises:
        StorageError: another one does, or the folder cannot be written.
    """
    try:
        file = (capture / FOLDER / LOCK).open("wb")
    except OSError as error:
        raise StorageError(f"The folder {capture} cannot be written ({error.strerror}).") from None
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise StorageError(
                f"Another process prepares {capture} now; wait for its end, or choose another folder with -o."
            ) from None
        except OSError:
            pass  # A file system without locks, as some networks' are.
        yield


def _origin(marker: Path) -> str | None:
    try:
        return str(json.loads(marker.read_text())["videos"])
    except (OSError, ValueError, KeyError, TypeError):
        return None
