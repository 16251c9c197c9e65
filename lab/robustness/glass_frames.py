# SPDX-License-Identifier: Apache-2.0
"""For ``glass``: when each frame of a live run passed each stage, as the run, the manifests and the page tell."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

STAGES = (
    "arrived", "matched", "handed over", "prepared", "fitted", "encoded", "written", "known", "fetched", "decoded",
    "drawn", "shown",
)  # fmt: skip
"""After being filmed. *Known*: the player has the manifest; *prepared*: the trainer has preprocessed the pictures."""
ONE_BY_ONE = ("decoded", "drawn", "shown")  # the others are told of the newest frame, and hold for those before it


def frames_of(
    entries: Sequence[Mapping[str, Any]],
    edges: Mapping[int, Mapping[str, float]],
    events: Iterable[tuple[str, int, float]],
) -> list[dict[str, float | None]]:
    """Seconds from being filmed to each stage, None for what did not happen or is not known; and ``frame``, ``filmed``.

    Args:
        entries: lines of the run's log.
        edges: ``edge`` of the manifests, by frame.
        events: what the page told: stage, frame, Unix time; in the order of time.
    """
    told = _first(events)
    found: list[dict[str, float | None]] = []
    for entry in entries:
        edge = edges.get(entry["index"])
        if edge is None or edge["captured_unix_seconds"] is None:
            continue
        live, seconds = entry["run"]["live"], entry["seconds"]
        filmed = edge["captured_unix_seconds"]
        encoded = edge["published_unix_seconds"] - filmed
        fitted = encoded - seconds["encode"]
        row: dict[str, float | None] = {
            "frame": entry["index"],
            "filmed": filmed,
            "arrived": live["arrived_seconds"],
            "matched": live["matched_seconds"],
            "handed over": live["delay_seconds"],
            "prepared": fitted - seconds["fit"],
            "fitted": fitted,
            "encoded": encoded,
            "written": encoded + seconds["write"],
        }
        for stage in STAGES[STAGES.index("known") :]:
            at = told.get((stage, entry["index"]))
            row[stage] = None if at is None else at - filmed
        found.append(row)
    return found


def _first(events: Iterable[tuple[str, int, float]]) -> dict[tuple[str, int], float]:
    """When each frame first passed each stage of the page."""
    found: dict[tuple[str, int], float] = {}
    newest: dict[str, int] = {}
    for stage, frame, at in events:
        first = frame if stage in ONE_BY_ONE else newest.get(stage, frame - 1) + 1
        for index in range(first, frame + 1):
            found.setdefault((stage, index), at)
        newest[stage] = max(newest.get(stage, -1), frame)
    return found
