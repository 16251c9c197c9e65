# SPDX-License-Identifier: Apache-2.0
"""The trainer itself, which fits the bundled clip, killed while viewers watch, for ``faults``."""

import os
import random
import signal
import time
import traceback
from functools import partial
from itertools import count
from pathlib import Path

from lab.robustness.fault_viewers import NAME, NUMBER, Trainer, ViewerRow, finish, wait_for_viewers, watched
from lab.robustness.stream_writers import content, edge_of, real_writer

FRAMES = 12
MAX_UNKILLED = 10


def killed_fits(*, kills: int, seed: int, folder: Path, players: int, page: bool) -> ViewerRow:
    """Streams of :data:`FRAMES` frames, whose trainers are killed at random moments, until there were ``kills``."""
    row, rng = ViewerRow("trainer that fits", seed=seed, equal=True), random.Random(f"fits {seed}")
    began = time.monotonic()
    Trainer(partial(_fit, folder / "whole")).end(None)
    frame_seconds = (time.monotonic() - began) / FRAMES
    whole = content(folder / "whole")
    streams, unkilled = count(), 0
    while row.kills < kills:
        place = folder / f"stream-{next(streams)}"
        place.mkdir()
        one = _stream(rng, whole, place, players=players, page=page, most=kills - row.kills, seconds=frame_seconds)
        added_up(row, one)
        # A stream may end before its first kill, on a busy machine even many in a row.
        unkilled = 0 if one.kills else unkilled + 1
        if unkilled == MAX_UNKILLED:
            raise RuntimeError(
                f"{unkilled} streams in a row ended before their first kill, after {row.kills} of {kills} kills; the "
                "machine starts the viewers too slowly for streams this short: try --no-page or fewer --players."
            )
    return row


def _stream(
    rng: random.Random, whole: bytes, folder: Path, *, players: int, page: bool, most: int, seconds: float
) -> ViewerRow:
    row, stream = ViewerRow("one stream", players=players), folder / "streams" / NAME
    with watched(folder, partial(_fit, stream), players=players, page=page) as (_, trainers, watching, shown):
        while row.kills < most and edge_of(stream) < FRAMES - 3:
            time.sleep(rng.uniform(0.0, 3.0 * seconds))
            reported = trainers.end(signal.SIGKILL)
            killed, edge = time.monotonic(), edge_of(stream)
            row.reported_frames_lost += max(reported - edge, 0)
            trainers.start()
            if edge >= FRAMES - 2:
                break  # What comes is too little to be told from what was there.
            wait_for_viewers(row, killed, edge, watching, shown)
        trainers.end(None)
        row.frames = edge_of(stream) + 1
        finish(row, whole, watching, shown, folder)
    return row


def _fit(folder: Path, writing: int) -> None:
    """The life of a trainer's process."""
    status = 1
    try:
        real_writer(FRAMES)(folder, lambda frame: os.write(writing, NUMBER.pack(frame)))
        status = 0
    except Exception:
        traceback.print_exc()
    finally:
        os._exit(status)


def added_up(row: ViewerRow, one: ViewerRow) -> None:
    """Adds a stream to a row of several."""
    for name, value in vars(one).items():
        if name == "page_notices":
            for text, times in value.items():
                row.page_notices[text] = row.page_notices.get(text, 0) + times
        elif name == "page_went_back":
            row.page_went_back = value if row.page_went_back is None else [*row.page_went_back, *(value or [])]
        elif name == "equal":
            row.equal = row.equal and value
        elif name not in ("what", "seed"):
            setattr(row, name, getattr(row, name) + value)
