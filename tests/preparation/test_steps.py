# SPDX-License-Identifier: Apache-2.0
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from structgstream.errors import StorageError
from structgstream.preparation.output_folder import FOLDER, Silent, Steps, Stored, fingerprint
from tests.support.killed import folders_of_the_killed


def run(steps: Steps, step: str, value: int, done: list[str], *, after: tuple[str, ...] = ()) -> int:
    def compute() -> int:
        done.append(step)
        return value

    return steps.run(
        step,
        {"value": value},
        compute,
        pack=lambda found: Stored({"found": found}, {"row": np.arange(found)}),
        unpack=lambda stored: stored.values["found"] if len(stored.arrays["row"]) == stored.values["found"] else -1,
        summary=str,
        after=after,
    )


def test_a_step_is_done_once(tmp_path: Path) -> None:
    done: list[str] = []
    steps = Steps(tmp_path, Silent())
    for _ in range(2):
        steps = Steps(tmp_path, Silent())
        assert run(steps, "a", 3, done) == 3
        assert run(steps, "b", 4, done, after=("a",)) == 4
    assert done == ["a", "b"]
    assert steps.skipped == ["a", "b"]


def test_a_change_does_what_depends_on_it_again(tmp_path: Path) -> None:
    done: list[str] = []
    for value in (3, 5):
        steps = Steps(tmp_path, Silent())
        run(steps, "a", value, done)
        run(steps, "b", 4, done, after=("a",))
        run(steps, "c", 7, done)
    assert done == ["a", "b", "c", "a", "b"]


def flip(file: Path) -> None:
    """Another bit in what is stored."""
    data = bytearray(file.read_bytes())
    data[60] ^= 1
    file.write_bytes(data)


@pytest.mark.parametrize(
    "damage",
    [
        lambda folder: (folder / "a.json").write_text("{"),
        lambda folder: (folder / "a.npz").write_bytes(b"PK"),
        lambda folder: (folder / "a.npz").unlink(),
        lambda folder: (folder / "a.npz").write_bytes((folder / "a.npz").read_bytes()[:-30]),
        lambda folder: flip(folder / "a.npz"),
        lambda folder: (folder / "a.json").unlink(),
    ],
)
def test_what_was_cut_is_done_again(tmp_path: Path, damage: Callable[[Path], object]) -> None:
    done: list[str] = []
    run(Steps(tmp_path, Silent()), "a", 3, done)
    damage(tmp_path / FOLDER)
    assert run(Steps(tmp_path, Silent()), "a", 3, done) == 3
    assert done == ["a", "a"]


def test_an_interruption_leaves_no_result(tmp_path: Path) -> None:
    def interrupted() -> int:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        Steps(tmp_path, Silent()).run(
            "a", {}, interrupted, pack=lambda _: Stored(), unpack=lambda _: 0, summary=lambda _: ""
        )
    assert not list(tmp_path.rglob("a.*"))


def test_killed_at_any_step_of_writing_it_is_done_again_or_was_done(tmp_path: Path) -> None:
    """Never the numbers of one result with the arrays of another."""

    def begin(folder: Path) -> None:
        run(Steps(folder, Silent()), "a", 3, [])

    for folder in folders_of_the_killed(tmp_path, lambda folder: run(Steps(folder, Silent()), "a", 5, []), begin=begin):
        for value in (3, 5, 3):
            assert run(Steps(folder, Silent()), "a", value, []) == value
        assert sorted(path.name for path in (folder / FOLDER).iterdir()) == ["a.json", "a.npz"]


def test_a_full_disk_is_reported(tmp_path: Path) -> None:
    (tmp_path / FOLDER).write_text("")
    with pytest.raises(StorageError, match=r"step 'a' cannot be written .* it goes on from there"):
        run(Steps(tmp_path, Silent()), "a", 1, [])


def test_a_fingerprint_is_of_content_and_time(tmp_path: Path) -> None:
    (tmp_path / "a").write_text("one")
    (tmp_path / "b").mkdir()
    (tmp_path / "b" / "c").write_text("two")
    files = {"a": tmp_path / "a", "b": tmp_path / "b"}
    before = fingerprint(files)
    assert fingerprint(files) == before
    (tmp_path / "b" / "c").write_text("three")
    assert fingerprint(files) != before
    (tmp_path / "b" / "d").mkdir()
    (tmp_path / "b" / "d" / "e").write_text("four")
    before = fingerprint(files)
    (tmp_path / "b" / "d" / "e").write_text("deeper")
    assert fingerprint(files) != before


class Heard:
    """A listener that records all calls."""

    def __init__(self) -> None:
        self.calls: list[tuple[object, ...]] = []

    def begin(self, step: str, *, skipped: bool) -> None:
        self.calls.append(("begin", step, skipped))

    def progress(self, done: int, total: int, what: str) -> None:
        self.calls.append(("progress", done, total, what))

    def end(self, step: str, summary: str) -> None:
        self.calls.append(("end", step, summary))


def test_steps_are_reported_and_their_summaries_recorded(tmp_path: Path) -> None:
    heard = Heard()
    steps = Steps(tmp_path / "capture", heard)
    steps.begin("scale", skipped=True)
    steps.progress(1, 3, "cam00")
    steps.end("scale", "metres")
    found = steps.run(
        "count",
        {},
        lambda: 4,
        pack=lambda value: Stored({"value": value}),
        unpack=lambda stored: stored.values["value"],
        summary={4: "four"}.__getitem__,
    )
    assert found == 4
    assert heard.calls == [
        ("begin", "scale", True), ("progress", 1, 3, "cam00"), ("end", "scale", "metres"),
        ("begin", "count", False), ("end", "count", "four"),
    ]  # fmt: skip
    assert steps.summaries == {"scale": "metres", "count": "four"}
