# SPDX-License-Identifier: Apache-2.0
"""A run ends with the same bytes whatever runs it and whatever happened before; what is whole is not made again."""

from dataclasses import replace
from pathlib import Path

import pytest

from structgstream.errors import ConfigError, StorageError, TaskError
from structgstream.executors.tasks import PYTHON, LocalEngine, Task, TaskQueue, TaskResult, WorkerSlot
from structgstream.parallel.driver import Job, Status, drive
from structgstream.parallel.parts import Parts, group_name
from tests.support.inline_engine import InlineEngine
from tests.support.stand_ins import job, sha256, workers

GROUPS = [(0, 4), (4, 8), (8, 12)]


def run(given: Job, parts: Parts, executor: TaskQueue | None = None) -> list[Status]:
    """Drives to the end, and returns what was reported."""
    reported: list[Status] = []
    with parts.locked(), workers() if executor is None else executor as queue:
        assert list(drive(given, parts, queue, listener=reported.append)) == GROUPS
    return reported


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("undisturbed")
    run(job(folder), Parts(folder / "parts"))
    return folder


def test_it_ends_with_all_frames_in_their_order(undisturbed: Path) -> None:
    lines = (undisturbed / "out.sgs").read_text().splitlines()
    assert [text.split()[:2] for text in lines] == [["frame", str(i)] for i in range(12)]


def test_notes_say_what_each_task_took(undisturbed: Path) -> None:
    notes = Parts(undisturbed / "parts").completed
    assert set(notes) == {"header", "track", "join", *(group_name(*group) for group in GROUPS)}
    assert [*notes][-1] == "join"
    assert notes["track"].frames == 12
    assert [notes[group_name(*group)].frames for group in GROUPS] == [4, 4, 4]
    assert all(note.seconds > 0 and note.bytes > 0 and note.attempts == 1 for note in notes.values())


def test_segments_are_joined_on_a_gpu_that_was_given(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "5,7")
    parts = Parts(tmp_path / "parts")
    run(replace(job(tmp_path), gpus=1), parts, TaskQueue(LocalEngine([WorkerSlot(1, 1)])))
    assert [parts.log(name).read_text() for name in ("track", "join")] == ["GPU 7\n", "GPU 5\n"]


class ElsewhereEngine(InlineEngine):
    """Logs stay on another machine; what tasks print comes with their endings."""

    def start(self, task: Task, *, gpus: int) -> None:
        super().start(replace(task, log=None), gpus=gpus)

    def ended(self, seconds: float) -> list[TaskResult]:
        return [replace(ending, output=f"{ending.name} says: {ending.output}") for ending in super().ended(seconds)]


def test_what_tasks_on_other_machines_print_is_kept_here(tmp_path: Path) -> None:
    given, parts = job(tmp_path, program=(PYTHON, "-m", "tests.support.stand_in")), Parts(tmp_path / "parts")
    run(given, parts, TaskQueue(ElsewhereEngine()))
    for name in ("header", "track", group_name(4, 8)):
        assert parts.log(name).read_text().startswith(f"{name} says: ")


def test_states_go_from_waiting_to_done(tmp_path: Path) -> None:
    reported = run(job(tmp_path), Parts(tmp_path / "parts"))
    assert reported[0].stage == "header"
    assert reported[-1].stage == "join"
    assert set(reported[-1].states) == {"done"}
    counts = [sum(state == "done" for state in status.states) for status in reported]
    assert counts == sorted(counts)


def modified(folder: Path) -> dict[str, int]:
    return {path.name: path.stat().st_mtime_ns for path in (folder / "parts" / "segments").glob("*.sgs")}


def test_a_second_call_makes_nothing_again(tmp_path: Path) -> None:
    given = job(tmp_path)
    run(given, Parts(tmp_path / "parts"))
    before, logs = modified(tmp_path), (tmp_path / "parts" / "done.jsonl").read_text()
    run(given, Parts(tmp_path / "parts"))
    assert modified(tmp_path) == before
    assert (tmp_path / "parts" / "done.jsonl").read_text() == logs


@pytest.mark.parametrize("damage", ["cut", "flipped", "gone", "empty"])
def test_a_segment_that_is_not_what_it_was_is_made_again(undisturbed: Path, tmp_path: Path, damage: str) -> None:
    given = job(tmp_path)
    run(given, Parts(tmp_path / "parts"))
    before, victim = modified(tmp_path), Parts(tmp_path / "parts").segment(4, 8)
    data = bytearray(victim.read_bytes())
    data[len(data) // 2] ^= 4
    victim.write_bytes({"cut": bytes(data[: len(data) // 3]), "empty": b""}.get(damage, bytes(data)))
    if damage == "gone":
        victim.unlink()
    (tmp_path / "out.sgs").write_bytes(b"half")
    run(given, Parts(tmp_path / "parts"))
    assert sha256(tmp_path / "out.sgs") == sha256(undisturbed / "out.sgs")
    after = modified(tmp_path)
    assert {name for name in after if after[name] != before[name]} == {victim.name}


def test_a_group_that_fails_is_reported_and_the_others_are_kept(undisturbed: Path, tmp_path: Path) -> None:
    given = job(tmp_path)
    bad = replace(given, unit=replace(given.unit, device=("--fail", "4")))
    with pytest.raises(TaskError, match=r"The task group-000004-000008 failed: There was no power\. \(complete output"):
        run(bad, Parts(tmp_path / "parts"))
    assert set(modified(tmp_path)) == {"group-000000-000004.sgs", "group-000008-000012.sgs"}
    assert not (tmp_path / "out.sgs").exists()


def test_parts_of_another_run_are_refused(tmp_path: Path) -> None:
    given = job(tmp_path)
    run(given, Parts(tmp_path / "parts"))
    other = replace(given, unit=replace(given.unit, capture="other"))
    with pytest.raises(ConfigError, match="parts of another run .capture: 'capture' there, 'other' asked for"):
        run(other, Parts(tmp_path / "parts"))


def test_a_track_that_fails_ends_the_run(tmp_path: Path) -> None:
    given = job(tmp_path)
    bad = replace(given, unit=replace(given.unit, track=("--groups", "many")))
    with pytest.raises(TaskError, match="The task track failed"):
        run(bad, Parts(tmp_path / "parts"))


def test_a_worker_that_does_not_see_the_folder_is_reported(tmp_path: Path) -> None:
    given = job(tmp_path)
    with pytest.raises(StorageError, match="do all machines see this folder at the same place"):
        run(replace(given, unit=replace(given.unit, program=("true",))), Parts(tmp_path / "parts"))
