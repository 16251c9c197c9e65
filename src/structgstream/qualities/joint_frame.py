# SPDX-License-Identifier: Apache-2.0
"""The joint report of a frame in all qualities, and its line in the log of the run."""

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from structgstream.session.frame_report import FrameReport

FIGURES = ("kind", "bytes", "train_psnr", "total_seconds", "cpu_seconds", "anchors", "free", "begins")
"""Keys that a line of the joint log contains for each quality, copied from that quality's own log."""


def joint_report(reports: Mapping[str, FrameReport]) -> FrameReport:
    """The sums of bytes and seconds; all other values are those of the finest quality, the last."""
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
        report: joint report of all qualities that were fitted now.
        entries: the frame's line in the log of each quality, by name, including qualities that had the frame already.
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
