# SPDX-License-Identifier: Apache-2.0
"""Groups of the small clip in pictures of 80x60 pixels, made once in a test run."""

from contextlib import closing
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from structgstream.api import reconstruct
from structgstream.groups.base import GroupBase, open_for
from structgstream.groups.first_frame import GroupStartConfig
from structgstream.groups.track_pass import TrackOptions, track_capture
from structgstream.groups.tracking import TrackConfig
from structgstream.groups.unit import SegmentTask, fit_segment
from tests.support.backends import quickest_backend
from tests.support.shared_folder import made_once
from tests.support.small_clip import small_clip_path
from tests.support.small_presets import QUICK

FRAMES, LENGTH = 6, 2
START = GroupStartConfig(iterations=6, rounds=2, births=50)
OPTIONS = TrackOptions(LENGTH, tracking=TrackConfig(cameras=5, picture_scale=1.0))
CAPTURE = small_clip_path()


@dataclass(frozen=True)
class Made:
    """A header, a track, and the segments of three groups."""

    header: Path
    track: Path
    segments: list[Path]


def track(path: Path, header: Path, *, options: TrackOptions = OPTIONS, stop_after: int = FRAMES) -> int:
    """Tracks into ``path``, at most ``stop_after`` frames; returns how many."""
    base = GroupBase.read(header)
    source, count = open_for(base.header, CAPTURE, frames=FRAMES), 0
    with closing(track_capture(path, source, base, options, quickest_backend())) as frames:
        for count, _ in enumerate(frames, 1):
            if count == stop_after:
                break
    return count


def task(made: Made, first: int, *, end: int | None = None) -> SegmentTask:
    """The group that begins at ``first``."""
    return SegmentTask(CAPTURE, made.header, made.track, first, first + LENGTH if end is None else end, START)


def fit(path: Path, group: SegmentTask, *, stop_after: int = FRAMES, overwrite: bool = False) -> int | None:
    """Fits a group, at most ``stop_after`` frames; returns how many, None if it is finished."""
    run = fit_segment(path, group, quickest_backend(), overwrite=overwrite)
    if run is None:
        return None
    count = 0
    with closing(run.reports) as reports:
        for count, _ in enumerate(reports, 1):
            if count == stop_after:
                break
    return count


@cache
def made() -> Made:
    """All of it, not to be changed."""
    return _made_in(made_once("groups", _make))


def _made_in(folder: Path) -> Made:
    segments = [folder / f"g{first}.sgs" for first in range(0, FRAMES, LENGTH)]
    return Made(folder / "header.sgs", folder / "track", segments)


def _make(folder: Path) -> None:
    found = _made_in(folder)
    reconstruct(CAPTURE, found.header, preset=QUICK, scale=0.25, frames=1, backend=quickest_backend())
    track(found.track, found.header)
    for number, segment in enumerate(found.segments):
        fit(segment, task(found, number * LENGTH))
