# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

from structgstream.preparation.options import PrepareOptions
from structgstream.preparation.steps import Stored, new_job


class Heard:
    """A listener that remembers all."""

    def __init__(self) -> None:
        self.calls: list[tuple[object, ...]] = []

    def begin(self, step: str, *, skipped: bool) -> None:
        self.calls.append(("begin", step, skipped))

    def progress(self, done: int, total: int, what: str) -> None:
        self.calls.append(("progress", done, total, what))

    def end(self, step: str, summary: str) -> None:
        self.calls.append(("end", step, summary))


def test_what_steps_found_is_told_and_noted(tmp_path: Path) -> None:
    heard = Heard()
    job = new_job(tmp_path / "videos", tmp_path / "capture", options=PrepareOptions(), listener=heard)
    job.listener.begin("scale", skipped=True)
    job.listener.progress(1, 3, "cam00")
    job.listener.end("scale", "metres")
    assert heard.calls == [("begin", "scale", True), ("progress", 1, 3, "cam00"), ("end", "scale", "metres")]
    assert job.summaries == {"scale": "metres"}


def test_steps_tell_the_same_listener_and_jobs_note_for_themselves(tmp_path: Path) -> None:
    heard = Heard()
    first = new_job(tmp_path, tmp_path / "capture", options=PrepareOptions(), listener=heard)
    other = new_job(tmp_path, tmp_path / "other", options=PrepareOptions(), listener=Heard())
    found = first.steps.run(
        "count",
        {},
        lambda: 4,
        pack=lambda value: Stored({"value": value}),
        unpack=lambda stored: stored.values["value"],
        summary={4: "four"}.__getitem__,
    )
    assert found == 4
    assert first.summaries == {"count": "four"}
    assert ("end", "count", "four") in heard.calls
    assert other.summaries == {}
