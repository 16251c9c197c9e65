# SPDX-License-Identifier: Apache-2.0
"""Whose folder a capture is: one that was made from other videos, or by hand, is never written into."""

import json
from pathlib import Path

from structgstream.errors import CaptureError, StorageError
from structgstream.preparation.steps import FOLDER

SOURCE = "source.json"


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
    try:
        marker.parent.mkdir(parents=True, exist_ok=True)
        marker.write_text(json.dumps({"videos": origin}) + "\n")
    except OSError as error:
        raise StorageError(f"The folder {capture} cannot be written ({error.strerror}).") from None


def _origin(marker: Path) -> str | None:
    try:
        return str(json.loads(marker.read_text())["videos"])
    except (OSError, ValueError, KeyError, TypeError):
        return None
