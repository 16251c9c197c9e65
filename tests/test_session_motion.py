# SPDX-License-Identifier: Apache-2.0
"""A stream that follows motion: each frame looks at the one before, also after a pause."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from small_presets import TINY_RIG
from structgstream.cameras import CameraRig
from structgstream.codec.reader import StreamReader
from structgstream.codec.sinks import FileSink
from structgstream.frame_report import FrameReport
from structgstream.frames import MultiViewFrame
from structgstream.kernels.backend import reference_backend
from structgstream.session import Session
from structgstream.struct_gstream import stream_pipeline
from structgstream.training.motion import MotionConfig
from worlds import moving_world

WORLD = moving_world(4, speed=0.06, movers=20)
CONFIG = replace(
    TINY_RIG,
    initial=replace(TINY_RIG.initial, iterations=20, schedule_iterations=20, coarse_iterations=10),
    online=replace(
        TINY_RIG.online,
        iterations=8,
        patching=replace(TINY_RIG.online.patching, iteration=4),
        motion=MotionConfig(enabled=True, reach_pixels=1, picture_scale=1.0),
    ),
)


@dataclass
class Capture:
    """The world's pictures; remembers which frames were asked for."""

    length: int
    asked: list[int]
    fps: float = 30.0
    name: str = "world"

    @property
    def rig(self) -> CameraRig:
        return WORLD.rig

    @property
    def points(self) -> np.ndarray:
        return WORLD.scene.anchors.positions.numpy()

    def __len__(self) -> int:
        return self.length

    def frames(self, start: int = 0) -> Iterator[MultiViewFrame]:
        for frame in WORLD.frames[start : self.length]:
            self.asked.append(frame.index)
            yield frame


def run(capture: Capture, sink: FileSink, *, resumed: StreamReader | None = None) -> list[FrameReport]:
    return list(Session(capture, sink, stream_pipeline(CONFIG), reference_backend(), resumed=resumed).run())


def test_a_resumed_stream_is_the_uninterrupted_one_byte_for_byte(tmp_path: Path) -> None:
    reports = run(Capture(4, []), FileSink(tmp_path / "whole.sgs"))
    assert all(0 < report.moving < report.anchors for report in reports[1:])

    run(Capture(2, []), FileSink(tmp_path / "begun.sgs"))
    sink, resumed = FileSink.resume(tmp_path / "begun.sgs")
    capture = Capture(4, [])
    run(capture, sink, resumed=resumed)
    assert capture.asked == [1, 2, 3]  # Frame 1 once more: what moves in frame 2 shows against it.
    assert (tmp_path / "begun.sgs").read_bytes() == (tmp_path / "whole.sgs").read_bytes()
