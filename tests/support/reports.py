# SPDX-License-Identifier: Apache-2.0
"""What a session tells of a frame, for tests of those who listen, and scores of frames that have some."""

from collections.abc import Mapping, Sequence
from typing import Any

from structgstream.codec.packets import PacketKind
from structgstream.evaluation.report import FrameScores, Report, Scores, mean_scores
from structgstream.session.loop import FrameReport


def frame_report(index: int, **known: Any) -> FrameReport:
    """The report of a frame of one anchor, but for what is ``known``."""
    usual: dict[str, Any] = {
        "pts_seconds": index / 30,
        "kind": PacketKind.DELTA if index else PacketKind.KEY,
        "bytes": 9,
        "field_bytes": {},
        "train_psnr": 20.0,
        "anchors": 1,
        "moving": 1,
        "free": 0,
        "spawned": 0,
        "pruned": 0,
        "seconds": {"total": 1.0},
    }
    return FrameReport(index=index, **{**usual, **known})


def frame_scores(index: int, cameras: Mapping[str, Scores], **known: Any) -> FrameScores:
    """A frame with scores of these cameras and 1000 bytes, but for what is ``known``."""
    usual: dict[str, Any] = {
        "pts_seconds": index / 30,
        "kind": "delta" if index else "key",
        "bytes": 1000,
        "field_bytes": {"free": 1000},
        "anchors": 50,
        "free": index,
        "decode_seconds": 0.1,
        "mean": mean_scores(cameras.values()) if cameras else None,
        "log": {},
    }
    return FrameScores(index=index, cameras=cameras, **{**usual, **known})


def report_of(frames: Sequence[FrameScores], **stream: Any) -> Report:
    """The report of frames that all have the same cameras."""
    cameras = {name: mean_scores(frame.cameras[name] for frame in frames) for name in frames[0].cameras}
    return Report(frames, cameras, mean_scores(mean_of(frame) for frame in frames), stream, {"python": "3"})


def mean_of(frame: FrameScores) -> Scores:
    """The mean scores of a frame of which a scored camera has a picture."""
    assert frame.mean is not None
    return frame.mean
