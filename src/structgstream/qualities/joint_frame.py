# SPDX-License-Identifier: Apache-2.0
"""A frame of all qualities: what they took together, and its line in the log of the run."""

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from structgstream.frame_report import FrameReport

FIGURES = ("kind", "bytes", "train_psnr", "total_seconds", "cpu_seconds", "anchors", "free", "begins")
"""What a line of the joint log has of each quality, from the line of that one's own log."""


def joint_report(reports: Mapping[str, FrameReport]) -> FrameReport:
    """The sums of bytes and seconds, and what is the same in all; the rest is that of the finest one, the last."""
    each = [*reports.values()]
    stages = dict.fromkeys(name for report in each for name in report.seconds)
    return replace(
        each[-1],
        bytes=sum(report.bytes for report in each),
        field_bytes={},
        train_psnr=math.nan,
        seconds={name: sum(report.seconds.get(name, 0.0) for report in each) for name in stages},
        cpu_seconds=sum(report.cpu_seconds for report in each),
    )


def joint_entry(report: FrameReport, entries: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """One line of the run's log.

    Args:
        report: of all qualities that were fitted now.
        entries: the frame's line in the log of each quality, by name; also of one that had the frame before.
    """
    each = {name: {key: entry[key] for key in FIGURES if key in entry} for name, entry in entries.items()}
    return {
        "index": report.index,
        "pts_seconds": report.pts_seconds,
        "bytes": sum(entry.get("bytes", 0) for entry in each.values()),
        "total_seconds": report.seconds["total"],
        **({"absent": list(report.absent)} if report.absent else {}),
        "qualities": each,
    }
