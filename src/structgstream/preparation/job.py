# SPDX-License-Identifier: Apache-2.0
"""What is prepared, and how: shared by the steps."""

from dataclasses import dataclass, field
from pathlib import Path

from structgstream.preparation.options import PrepareOptions
from structgstream.preparation.steps import Listener, Steps


@dataclass(frozen=True)
class Job:
    """One preparation.

    Args:
        videos: the folder of what was filmed.
        capture: the folder to make.
        options: what is asked for.
        listener: is told of steps.
        steps: runs them, or takes their results from the disk.
        told: what each step found, in words.
    """

    videos: Path
    capture: Path
    options: PrepareOptions
    listener: Listener
    steps: Steps
    told: dict[str, str] = field(default_factory=dict)


def new_job(videos: Path, capture: Path, *, options: PrepareOptions, listener: Listener) -> Job:
    """A preparation that has not begun."""
    told: dict[str, str] = {}
    noting = _Noting(listener, told)
    return Job(videos, capture, options, noting, Steps(capture, noting), told)


class _Noting:
    """Passes everything on, and notes what steps found."""

    def __init__(self, listener: Listener, told: dict[str, str]) -> None:
        self._listener, self._told = listener, told

    def begin(self, step: str, *, skipped: bool) -> None:
        self._listener.begin(step, skipped=skipped)

    def progress(self, done: int, total: int, what: str) -> None:
        self._listener.progress(done, total, what)

    def end(self, step: str, summary: str) -> None:
        self._told[step] = summary
        self._listener.end(step, summary)
