# SPDX-License-Identifier: Apache-2.0
"""What a session tells of a frame, for tests of those who listen, and scores of frames that have some."""

from typing import Any

from structgstream.codec.packets import PacketKind
from structgstream.evaluation.report import FrameScores, Scores
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


def mean_of(frame: FrameScores) -> Scores:
    """The mean scores of a frame of which a scored camera has a picture."""
    assert frame.mean is not None
    return frame.mean
