# SPDX-License-Identifier: Apache-2.0
"""The clip that comes with the package: ten cameras, twelve frames, 320x240."""

from importlib.resources import files
from pathlib import Path

from structgstream.data.json_videos import open_json_videos, recognizes_json_videos
from structgstream.data.source import FrameSource
from structgstream.errors import CaptureError


def bundled_clip_path() -> Path:
    """The folder of the bundled clip.

    Raises:
        CaptureError: the installation lacks the clip.
    """
    folder = Path(str(files("structgstream.data") / "clip"))
    if not recognizes_json_videos(folder):
        raise CaptureError("The bundled clip is missing from the installation; reinstall structgstream.")
    return folder


def bundled_clip() -> FrameSource:
    """The bundled clip, as a capture."""
    return open_json_videos(bundled_clip_path())
