# SPDX-License-Identifier: Apache-2.0
"""Whose folder a capture is, and who works on it."""

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from structgstream.errors import CaptureError, StorageError
from structgstream.preparation.output_folder import (
    FOLDER,
    SOURCE,
    Link,
    Packing,
    Silent,
    Steps,
    Stored,
    fingerprint,
    link,
    lock_output,
    mark_output,
    plain,
    unlink,
)
from tests.support.killed import folders_of_the_killed
from tests.support.quick_preparation import Heard


@pytest.fixture
def videos(tmp_path: Path) -> Path:
    (tmp_path / "take").mkdir()
    return tmp_path / "take"


@pytest.mark.parametrize("there", [False, True])
def test_a_new_or_an_empty_folder_is_claimed_for_good(tmp_path: Path, videos: Path, there: bool) -> None:
    capture = tmp_path / "out" / "capture"
    if there:
        capture.mkdir(parents=True)
    mark_output(capture, videos)
    marker = capture / FOLDER / SOURCE
    written = marker.read_bytes()
    (capture / "capture.json").write_text("{}")
    mark_output(capture, videos)
    mark_output(tmp_path / "out" / ".." / "out" / "capture", tmp_path / "take" / ".." / "take")
    assert marker.read_bytes() == written


@pytest.mark.parametrize("broken", ["{", "[]", '{"other": 1}'])
def test_a_capture_of_other_videos_is_left_alone(tmp_path: Path, videos: Path, broken: str) -> None:
    mark_output(tmp_path / "capture", videos)
    (tmp_path / "other").mkdir()
    with pytest.raises(CaptureError, match=rf"was prepared from {videos}, not from {tmp_path / 'other'}"):
        mark_output(tmp_path / "capture", tmp_path / "other")
    (tmp_path / "capture" / FOLDER / SOURCE).write_text(broken)
    with pytest.raises(CaptureError, match="was prepared from None"):
        mark_output(tmp_path / "capture", videos)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda folder: folder.write_text("notes"), "is a file"),
        (lambda folder: (folder / "notes").mkdir(parents=True), "is not empty and was not made by prepare"),
    ],
)
def test_what_was_made_by_hand_is_left_alone(
    tmp_path: Path, videos: Path, make: Callable[[Path], object], message: str
) -> None:
    make(tmp_path / "capture")
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(CaptureError, match=message):
        mark_output(tmp_path / "capture", videos)
    assert sorted(tmp_path.rglob("*")) == before


def test_the_videos_own_folder_is_no_capture(videos: Path) -> None:
    with pytest.raises(CaptureError, match="cannot be the folder of the videos itself"):
        mark_output(videos / ".." / "take", videos)


def test_a_folder_that_cannot_be_made_is_reported(tmp_path: Path, videos: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(StorageError, match="cannot be written"):
        mark_output(tmp_path / "file" / "capture", videos)


def test_killed_at_any_step_it_leaves_the_folder_free_for_the_next_time(tmp_path: Path, videos: Path) -> None:
    killed = folders_of_the_killed(
        tmp_path,
        lambda folder: mark_output(folder / "capture", videos),
        begin=lambda folder: (folder / "capture").mkdir(),
    )
    for folder in killed:
        mark_output(folder / "capture", videos)
        assert [path.name for path in (folder / "capture").rglob("*")] == [FOLDER, SOURCE]


def test_one_at_a_time(tmp_path: Path, videos: Path) -> None:
    """The lock belongs to the open file, so that it is the same in one process and in two."""
    mark_output(tmp_path / "capture", videos)
    mark_output(tmp_path / "other", videos)
    refused = pytest.raises(StorageError, match="Another process prepares .*capture now; wait for its end")
    with lock_output(tmp_path / "capture"), lock_output(tmp_path / "other"), refused:
        lock_output(tmp_path / "capture").__enter__()
    with lock_output(tmp_path / "capture"):
        pass


def test_a_folder_that_was_not_claimed_cannot_be_held(tmp_path: Path) -> None:
    with pytest.raises(StorageError, match="cannot be written"):
        lock_output(tmp_path / "capture").__enter__()


def test_each_kind_of_link(tmp_path: Path) -> None:
    source = tmp_path / "a.mp4"
    source.write_text("film")
    link(source, tmp_path / "hard" / "a.mp4", how="hard")
    link(source, tmp_path / "soft" / "a.mp4", how="symlink")
    link(source, tmp_path / "copy" / "a.mp4", how="copy")
    assert (tmp_path / "hard" / "a.mp4").samefile(source)
    assert (tmp_path / "soft" / "a.mp4").is_symlink()
    assert (tmp_path / "copy" / "a.mp4").read_text() == "film"
    assert not (tmp_path / "copy" / "a.mp4").samefile(source)


def test_what_is_there_stays_and_what_changed_is_renewed(tmp_path: Path) -> None:
    source, target = tmp_path / "a.mp4", tmp_path / "copy" / "a.mp4"
    source.write_text("film")
    link(source, target, how="copy")
    inode = target.stat().st_ino
    link(source, target, how="copy")
    assert target.stat().st_ino == inode
    source.write_text("another film")
    link(source, target, how="copy")
    assert target.read_text() == "another film"
    link(source, target, how="hard")
    assert target.read_text() == "another film"


def test_a_link_that_cannot_be_made_is_a_copy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(source: Path, target: Path) -> None:
        raise OSError(18, "Invalid cross-device link")

    monkeypatch.setattr(os, "link", refused)
    (tmp_path / "a").write_text("film")
    link(tmp_path / "a", tmp_path / "b" / "a", how="hard")
    assert (tmp_path / "b" / "a").read_text() == "film"


@pytest.mark.parametrize("kind", [OSError(28, "No space left on device"), KeyboardInterrupt()])
def test_a_copy_that_is_broken_off_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: BaseException
) -> None:
    def cut(source: Path, target: Path) -> None:
        target.write_bytes(source.read_bytes()[:2])
        raise kind

    monkeypatch.setattr(shutil, "copy2", cut)
    (tmp_path / "a").write_text("film")
    with pytest.raises((StorageError, KeyboardInterrupt)):
        link(tmp_path / "a", tmp_path / "b" / "a", how="copy")
    assert not list((tmp_path / "b").iterdir())


@pytest.mark.parametrize("how", ["hard", "symlink", "copy"])
def test_what_was_brought_can_be_taken_back(tmp_path: Path, how: Link) -> None:
    (tmp_path / "cam").mkdir()
    (tmp_path / "cam" / "0.png").write_text("mask")
    link(tmp_path / "cam", tmp_path / "out" / "cam", how=how)
    (tmp_path / "out" / "cam" / "1.png").write_text("by hand")
    unlink(tmp_path / "cam", tmp_path / "out" / "cam")
    assert [file.name for file in (tmp_path / "out" / "cam").iterdir()] == ["1.png"]
    (tmp_path / "out" / "cam" / "1.png").unlink()
    unlink(tmp_path / "cam", tmp_path / "out" / "cam")
    assert not (tmp_path / "out" / "cam").exists()
    assert (tmp_path / "cam" / "0.png").is_file()


def run(steps: Steps, step: str, value: int, done: list[str], *, after: tuple[str, ...] = ()) -> int:
    def compute() -> int:
        done.append(step)
        return value

    packing = Packing[int](
        lambda found: Stored({"found": found}, {"row": np.arange(found)}),
        lambda stored: stored.values["found"] if len(stored.arrays["row"]) == stored.values["found"] else -1,
    )
    return steps.run(step, {"value": value}, compute, packing, summary=str, after=after)


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


def test_steps_are_reported_and_their_summaries_recorded(tmp_path: Path) -> None:
    heard = Heard()
    steps = Steps(tmp_path / "capture", heard)
    steps.begin("scale", skipped=True)
    steps.progress(1, 3, "cam00")
    steps.end("scale", "metres")
    assert steps.run("count", {}, lambda: 4, plain("value"), summary={4: "four"}.__getitem__) == 4
    assert heard.calls == [
        ("begin", "scale", True), ("progress", 1, 3, "cam00"), ("end", "scale", "metres"),
        ("begin", "count", False), ("end", "count", "four"),
    ]  # fmt: skip
    assert steps.summaries == {"scale": "metres", "count": "four"}
