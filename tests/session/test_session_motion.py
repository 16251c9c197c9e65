# SPDX-License-Identifier: Apache-2.0
"""A stream that follows motion: each frame looks at the one before, also after a pause."""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

from structgstream.codec.reader import StreamReader, open_stream
from structgstream.codec.sinks import FileSink
from structgstream.frames import MultiViewFrame
from structgstream.session.loop import FrameReport, Session
from structgstream.session.struct_gstream import stream_pipeline
from structgstream.training.online.config import MotionConfig
from tests.support.backends import quickest_backend
from tests.support.memory_captures import MemoryCapture
from tests.support.small_presets import TINY_RIG
from tests.support.varied import varied
from tests.support.worlds import moving_world

WORLD = moving_world(4, speed=0.06, movers=20)
CONFIG = replace(
    TINY_RIG,
    initial=replace(TINY_RIG.initial, iterations=20, schedule_iterations=20, coarse_iterations=10),
    online=replace(
        TINY_RIG.online,
        iterations=8,
        patching=replace(TINY_RIG.online.patching, iteration=4),
        motion=varied(MotionConfig(enabled=True, picture_scale=1.0), REACH_PIXELS=1),
    ),
)


@dataclass
class Capture(MemoryCapture):
    """Remembers which frames were asked for."""

    asked: list[int] = field(default_factory=list)

    def frames(self, start: int = 0) -> Iterator[MultiViewFrame]:
        for frame in super().frames(start):
            self.asked.append(frame.index)
            yield frame


def capture(length: int) -> Capture:
    """The world's pictures."""
    return Capture(WORLD.rig, WORLD.frames[:length], points=WORLD.scene.anchors.positions.numpy())


def run(source: Capture, sink: FileSink, *, resumed: StreamReader | None = None) -> list[FrameReport]:
    return list(Session(source, sink, stream_pipeline(CONFIG), quickest_backend(), resumed=resumed).run())


def test_a_resumed_stream_is_the_uninterrupted_one_byte_for_byte(tmp_path: Path) -> None:
    reports = run(capture(4), FileSink(tmp_path / "whole.sgs"))
    assert all(0 < report.moving < report.anchors for report in reports[1:])

    last = open_stream(tmp_path / "whole.sgs").packets[1]
    (tmp_path / "begun.sgs").write_bytes((tmp_path / "whole.sgs").read_bytes()[: last.offset + last.bytes])
    sink, resumed = FileSink.resume(tmp_path / "begun.sgs")
    whole = capture(4)
    run(whole, sink, resumed=resumed)
    assert whole.asked == [1, 2, 3]  # Frame 1 once more: what moves in frame 2 shows against it.
    assert (tmp_path / "begun.sgs").read_bytes() == (tmp_path / "whole.sgs").read_bytes()
