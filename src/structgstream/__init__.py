# SPDX-License-Identifier: Apache-2.0
"""Free-viewpoint video streams from synchronised cameras, reconstructed frame by frame.

:func:`prepare` makes a capture from videos, and :func:`check` checks one. :func:`reconstruct` makes a stream from a
capture, :func:`open_stream` opens it for rendering, :func:`evaluate` scores it and :func:`export` writes it in other
formats. Cameras and points are in the units of the capture, except in a :class:`Scene`, which is normalised
(``docs/conventions.md``).

Names are imported on first use, so that ``import structgstream`` is fast and needs no optional package.
"""

import importlib
from typing import TYPE_CHECKING

from structgstream.version import __version__ as __version__

if TYPE_CHECKING:
    from structgstream.api import check, evaluate, example_clip, export, prepare, reconstruct
    from structgstream.cameras import Camera, CameraRig, Similarity
    from structgstream.codec.contents import PacketInfo
    from structgstream.codec.packets import Packet, PacketKind, StreamHeader
    from structgstream.codec.reader import StreamReader, open_stream
    from structgstream.codec.sinks import FileSink, MemorySink
    from structgstream.data.open import open_capture
    from structgstream.data.source import FrameSource
    from structgstream.errors import StructGStreamError
    from structgstream.evaluation.report import FrameScores, Report, Scores
    from structgstream.exporters.formats import FrameOptions
    from structgstream.frames import MultiViewFrame
    from structgstream.kernels.backend import Backend, select_backend
    from structgstream.memory import PeakKind
    from structgstream.pose_check.check import Finding
    from structgstream.preparation.checking.check import CheckReport
    from structgstream.preparation.options import PrepareOptions
    from structgstream.preparation.prepare import Preparation
    from structgstream.scene.render import Rendering, render
    from structgstream.scene.scene import Scene
    from structgstream.session.frame_report import FrameReport
    from structgstream.session.loop import Session
    from structgstream.session.pipeline import Pipeline
    from structgstream.session.presets import PRESETS, StreamConfig
    from structgstream.session.struct_gstream import stream_pipeline

_NAMES = {
    "api": "check evaluate example_clip export prepare reconstruct",
    "cameras": "Camera CameraRig Similarity",
    "codec.contents": "PacketInfo",
    "codec.packets": "Packet PacketKind StreamHeader",
    "codec.reader": "StreamReader open_stream",
    "codec.sinks": "FileSink MemorySink",
    "data.open": "open_capture",
    "data.source": "FrameSource",
    "errors": "StructGStreamError",
    "evaluation.report": "FrameScores Report Scores",
    "exporters.formats": "FrameOptions",
    "frames": "MultiViewFrame",
    "kernels.backend": "Backend select_backend",
    "memory": "PeakKind",
    "pose_check.check": "Finding",
    "preparation.checking.check": "CheckReport",
    "preparation.options": "PrepareOptions",
    "preparation.prepare": "Preparation",
    "scene.render": "Rendering render",
    "scene.scene": "Scene",
    "session.frame_report": "FrameReport",
    "session.loop": "Session",
    "session.pipeline": "Pipeline",
    "session.presets": "PRESETS StreamConfig",
    "session.struct_gstream": "stream_pipeline",
}
_HOMES = {name: module for module, names in _NAMES.items() for name in names.split()}

__all__ = [
    "PRESETS",
    "Backend",
    "Camera",
    "CameraRig",
    "CheckReport",
    "FileSink",
    "Finding",
    "FrameOptions",
    "FrameReport",
    "FrameScores",
    "FrameSource",
    "MemorySink",
    "MultiViewFrame",
    "Packet",
    "PacketInfo",
    "PacketKind",
    "PeakKind",
    "Pipeline",
    "Preparation",
    "PrepareOptions",
    "Rendering",
    "Report",
    "Scene",
    "Scores",
    "Session",
    "Similarity",
    "StreamConfig",
    "StreamHeader",
    "StreamReader",
    "StructGStreamError",
    "check",
    "evaluate",
    "example_clip",
    "export",
    "open_capture",
    "open_stream",
    "prepare",
    "reconstruct",
    "render",
    "select_backend",
    "stream_pipeline",
]


def __getattr__(name: str) -> object:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
