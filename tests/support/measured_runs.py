# SPDX-License-Identifier: Apache-2.0
"""Parts of a run whose notes and logs are made by hand."""

import json
from pathlib import Path

from structgstream.executors.tasks import TaskResult
from structgstream.parallel.parts import Parts, group_name

GROUPS = [(0, 4), (4, 8), (8, 12)]


def entry(index: int, seconds: float, size: int, kind: str) -> str:
    return json.dumps({"index": index, "total_seconds": seconds, "bytes": size, "kind": kind}) + "\n"


def finished_run(folder: Path) -> Path:
    """Every process takes 3 s, a first frame 9 s, another 2 s."""
    parts = Parts(folder / "parts")
    with parts.locked():
        parts.track.with_name("track.sgt.groups").write_text("".join(f"{a}:{b}\n" for a, b in GROUPS))
        parts.header.write_bytes(bytes(1000))
        parts.track.write_bytes(b"track")
        parts.record(TaskResult("header", 0, 30.0), "", parts.header, frames=1)
        parts.record(TaskResult("track", 0, 3.0 + 11 * 0.5), "", parts.track, frames=12)
        for a, b in GROUPS:
            segment = parts.segment(a, b)
            segment.write_bytes(b"segment")
            frames = [entry(i, 2.0, 10, "delta") for i in range(a + 1, b)]
            first = [] if not a else [entry(a, 9.0, 50, "key")]
            segment.with_suffix(".log.jsonl").write_text("".join([*first, *frames]))
            seconds = 3.0 + 2.0 * (b - a - 1) + (9.0 if a else 0.0)
            parts.record(TaskResult(group_name(a, b), 0, seconds, 1, 7000), "", segment, frames=b - a)
        parts.record(TaskResult("join", 0, 4.2), "", parts.header, frames=12)
    return parts.folder
