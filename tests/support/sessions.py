# SPDX-License-Identifier: Apache-2.0
"""Whole sessions of captures in memory, and of those that are resumed."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from structgstream.codec.packets import PacketSink
from structgstream.codec.sinks import FileSink
from structgstream.data.source import FrameSource
from structgstream.session.frame_report import FrameReport
from structgstream.session.loop import Session
from structgstream.session.presets import StreamConfig
from structgstream.session.struct_gstream import stream_pipeline
from tests.support.backends import quickest_backend


def run_session(source: FrameSource, sink: PacketSink, config: StreamConfig, **options: Any) -> list[FrameReport]:
    """The reports of all frames; ``options`` are those of ``Session``."""
    return list(Session(source, sink, stream_pipeline(config), quickest_backend(), **options).run())


def resume_in(path: Path, begun: bytes, run: Callable[..., list[FrameReport]]) -> list[FrameReport]:
    """``run(sink, resumed=...)`` of a file that holds what was ``begun`` of a stream."""
    path.write_bytes(begun)
    sink, resumed = FileSink.resume(path)
    return run(sink, resumed=resumed)
