# SPDX-License-Identifier: Apache-2.0
"""Results of ``lab.robustness.faults`` as Markdown; rows of one kind and several seeds are added up."""

import statistics
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

Row = Mapping[str, Any]
CAMERAS = (
    "camera", "moments", "reported frames lost", "smeared pictures", "pictures of another instant", "counted",
    "absent frames a moment", "s until normal: median, 95 %, most", "never normal", "others' pictures lacking",
    "longest gap between frames, s",
)  # fmt: skip
VIEWERS = (
    "killed", "kills", "frames", "reported frames lost", "bytes of a stream never interrupted",
    "players with every byte", "s until all players go on: median, most", "s until the page shows it: median, most",
    "page: errors, went back",
)  # fmt: skip


def table(result: Mapping[str, Sequence[Row]]) -> str:
    """Both tables."""
    cameras = _table(CAMERAS, map(_cameras, _merged(result["cameras"])))
    return f"{cameras}\n\n{_table(VIEWERS, map(_viewers, _merged(result['viewers'])))}"


def _merged(rows: Sequence[Row]) -> Iterable[dict[str, Any]]:
    found: dict[str, dict[str, Any]] = {}
    for row in rows:
        if row["what"] not in found:
            found[row["what"]] = {**row}
            continue
        kept = found[row["what"]]
        for name, value in row.items():
            if name not in kept:
                kept[name] = value  # an earlier version did not count it
            elif name.startswith("longest"):
                kept[name] = max(kept[name], value)
            elif name == "equal":
                kept[name] = kept[name] and value
            elif isinstance(value, (int, float, list)) and name != "seed":
                kept[name] = kept[name] + value
    return found.values()


def _table(heads: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    lines = [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
    return "\n".join([*lines, *(f"| {' | '.join(map(str, row))} |" for row in rows)])


def _cameras(row: Row) -> Sequence[object]:
    times = sorted(row["seconds_until_normal"])
    normal = f"{statistics.median(times):.2f}, {times[int(0.95 * len(times))]:.2f}, {times[-1]:.2f}" if times else "-"
    return (
        row["what"], row["moments"], row["reported_frames_lost"], row["smeared"], row["apart"], row["counted"],
        f"{statistics.mean(row['absent_frames']):.1f}", normal, row["never_normal"],
        f"{row['others_lacking']} of {row['others']:,}", f"{row['longest_gap_seconds']:.2f}",
    )  # fmt: skip


def _viewers(row: Row) -> Sequence[object]:
    back = row["page_went_back"]
    return (
        row["what"], row["kills"], f"{row['frames']:,}", row["reported_frames_lost"], "yes" if row["equal"] else "NO",
        f"{row['exact']} of {row['players']}", _times(row["seconds_until_normal"]),
        _times(row["page_seconds_until_normal"]), "-" if back is None else f"{len(row['page_errors'])}, {len(back)}",
    )  # fmt: skip


def _times(seconds: Sequence[float]) -> str:
    return f"{statistics.median(seconds):.2f}, {max(seconds):.2f}" if seconds else "-"
