# SPDX-License-Identifier: Apache-2.0
"""Whose folder a capture is: one of other videos, made by hand, or in another process's hands is not written into."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from structgstream.atomic_files import partial_path, replacing
from structgstream.errors import CaptureError, StorageError
from structgstream.file_locks import lock_file, open_lockable
from structgstream.preparation.steps import FOLDER

SOURCE = "source.json"
LOCK = ".preparing"
_CLAIMS = (Path(FOLDER), partial_path(Path(FOLDER, SOURCE)))
"""What a claim that was killed or met a full disk leaves in a folder, which is as free as before."""


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
    if any(entry not in _CLAIMS for entry in _below(capture)):
        raise CaptureError(f"The folder {capture} is not empty and was not made by prepare; choose another with -o.")
    try:
        marker.parent.mkdir(parents=True, exist_ok=True)
        with replacing(marker) as file:
            file.write(f"{json.dumps({'videos': origin})}\n".encode())
    except OSError as error:
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
        file = open_lockable(capture / FOLDER / LOCK)
    except OSError as error:
        raise StorageError(f"The folder {capture} cannot be written ({error.strerror}).") from None
    with file:
        if not lock_file(file):
            raise StorageError(
                f"Another process prepares {capture} now; wait for its end, or choose another folder with -o."
            )
        yield


def _below(folder: Path) -> Iterator[Path]:
    """Everything in a folder and its folders, relative to it; nothing if there is none."""
    return (path.relative_to(folder) for path in folder.rglob("*"))


def _origin(marker: Path) -> str | None:
    try:
        return str(json.loads(marker.read_text())["videos"])
    except (OSError, ValueError, KeyError, TypeError):
        return None
