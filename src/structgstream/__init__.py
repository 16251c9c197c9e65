# SPDX-License-Identifier: Apache-2.0
"""A ring of synchronised cameras to a free-viewpoint video stream, frame by frame.

Names are resolved on first use, so that ``import structgstream`` costs nothing and needs no optional package.
"""

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from structgstream.cameras import Camera, CameraRig
    from structgstream.codec.packets import Packet, StreamHeader
    from structgstream.codec.reader import StreamReader, open_stream
    from structgstream.codec.sinks import FileSink, MemorySink
    from structgstream.data.open import open_capture
    from structgstream.errors import StructGStreamError
    from structgstream.frames import MultiViewFrame
    from structgstream.kernels.backend import Backend, select_backend
    from structgstream.presets import PRESETS, StreamConfig
    from structgstream.scene.render import render
    from structgstream.scene.scene import Scene
    from structgstream.session import Session

__version__ = "0.1.0"

_HOMES = {
    "Backend": "kernels.backend",
    "Camera": "cameras",
    "CameraRig": "cameras",
    "FileSink": "codec.sinks",
    "MemorySink": "codec.sinks",
    "MultiViewFrame": "frames",
    "PRESETS": "presets",
    "Packet": "codec.packets",
    "Scene": "scene.scene",
    "Session": "session",
    "StreamConfig": "presets",
    "StreamHeader": "codec.packets",
    "StreamReader": "codec.reader",
    "StructGStreamError": "errors",
    "open_capture": "data.open",
    "open_stream": "codec.reader",
    "render": "scene.render",
    "select_backend": "kernels.backend",
}

__all__ = [
    "PRESETS",
    "Backend",
    "Camera",
    "CameraRig",
    "FileSink",
    "MemorySink",
    "MultiViewFrame",
    "Packet",
    "Scene",
    "Session",
    "StreamConfig",
    "StreamHeader",
    "StreamReader",
    "StructGStreamError",
    "open_capture",
    "open_stream",
    "render",
    "select_backend",
]


def __getattr__(name: str) -> object:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)
