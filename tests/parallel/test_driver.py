# SPDX-License-Identifier: Apache-2.0
"""The commands of a run and the folder of its parts; it ends with the same bytes whatever happened before."""

import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from structgstream.cli.groups import FitGroup, Join, Track
from structgstream.cli.options import parse_options
from structgstream.errors import ConfigError, StorageError, TaskError
from structgstream.executors.tasks import PYTHON, LocalEngine, Task, TaskQueue, TaskResult, WorkerSlot
from structgstream.owned_folders import MARKER
from structgstream.parallel.driver import Job, Status, Unit, drive
from structgstream.parallel.parts import Parts, group_name, read_completed
from tests.support.inline_engine import InlineEngine
from tests.support.killed import folders_of_the_killed
from tests.support.stand_ins import job, sha256, workers


@pytest.fixture
def planned(tmp_path: Path) -> Parts:
    return Parts(tmp_path / "parts")


def unit(folder: Path, **given: object) -> Unit:
    (folder / "capture").mkdir()
    return Unit(str(folder / "capture"), device=("--device", "cpu"), **given)  # type: ignore[arg-type]


def after(command: tuple[str, ...], word: str) -> list[str]:
    """What ``structgstream WORD`` is given."""
    assert command[:4] == (PYTHON, "-m", "structgstream", word)
    return [*command[4:]]


def test_the_tracking_pass_is_what_was_asked_for(tmp_path: Path, planned: Parts) -> None:
    task = unit(tmp_path, frames=40, track=("--groups", "8", "--split-at-low-motion")).track_task(planned)
    planned.header.parent.mkdir(parents=True)
    planned.header.touch()
    found = parse_options(Track, "track", arguments=after(task.command, "track"))
    assert (found.scene, found.init, found.output) == (tmp_path / "capture", planned.header, planned.track)
    assert (found.frames, found.groups, found.split_at_low_motion, found.device) == (40, 8, True, "cpu")
    assert (task.name, task.result, task.log) == ("track", str(planned.track), planned.log("track"))
    assert not task.environment


def test_a_group_is_what_was_asked_for(tmp_path: Path, planned: Parts) -> None:
    task = unit(tmp_path).group_task(planned, 8, 16)
    planned.header.parent.mkdir(parents=True)
    planned.header.touch()
    found = parse_options(FitGroup, "fit-group", arguments=after(task.command, "fit-group"))
    assert (found.scene, found.init, found.track) == (tmp_path / "capture", planned.header, planned.track)
    assert (found.frames, found.output, found.device) == ("8:16", planned.segment(8, 16), "cpu")
    assert task.result == str(planned.segment(8, 16))


def test_frame_0_may_be_resumed_and_all_segments_are_joined(tmp_path: Path, planned: Parts) -> None:
    given_unit = unit(tmp_path, header=("--preset", "tiny"))
    words = after(given_unit.header_task(planned).command, "reconstruct")
    assert words == [
        str(tmp_path / "capture"), "-o", str(planned.header), "--frames", "1", "--resume", "--sound", "none",
        "--preset", "tiny", "--device", "cpu",
    ]  # fmt: skip
    task = given_unit.join_task(planned, [(0, 8), (8, 16)], tmp_path / "out.sgs")
    found = parse_options(Join, "join", arguments=after(task.command, "join"))
    assert found.segments == (planned.segment(0, 8), planned.segment(8, 16))
    assert (found.output, found.overwrite) == (tmp_path / "out.sgs", True)
    assert (found.device, found.plain, found.workers) == ("auto", False, None)
    given_unit = replace(given_unit, join=("--device", "reference", "--workers", "3"))
    task = given_unit.join_task(planned, [(0, 8)], tmp_path / "out.sgs")
    found = parse_options(Join, "join", arguments=after(task.command, "join"))
    assert (found.device, found.workers) == ("reference", 3)


def test_without_a_number_all_frames_are_tracked_with_as_many_threads_as_asked(tmp_path: Path, planned: Parts) -> None:
    task = unit(tmp_path, track_threads=3).track_task(planned)
    assert "--frames" not in task.command
    assert task.environment["OMP_NUM_THREADS"] == "3"


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


@pytest.fixture
def parts(tmp_path: Path) -> Parts:
    made = Parts(tmp_path / "parts")
    with made.locked():
        made.header.write_bytes(b"header")
        made.record(TaskResult("header", 0, 2.5, 3, 1000), "key", made.header, frames=1)
    return made


def test_a_note_is_read_again(parts: Parts) -> None:
    note = Parts(parts.folder).completed["header"]
    assert (note.seconds, note.attempts, note.peak_bytes, note.bytes, note.frames) == (2.5, 3, 1000, 6, 1)


def test_what_was_only_found_whole_keeps_what_it_took(parts: Parts) -> None:
    parts.record(TaskResult("header", 0, 0.1), "key", parts.header, frames=1)
    assert Parts(parts.folder).completed["header"].seconds == 2.5


def test_whole_is_the_same_task_and_the_same_bytes(parts: Parts) -> None:
    assert parts.is_complete("header", "key", parts.header)
    assert not parts.is_complete("header", "another key", parts.header)
    assert not parts.is_complete("track", "key", parts.header)
    parts.header.write_bytes(b"Header")
    assert not parts.is_complete("header", "key", parts.header)
    parts.header.unlink()
    assert not parts.is_complete("header", "key", parts.header)


def test_torn_notes_are_passed_over(parts: Parts) -> None:
    path = parts.folder / "done.jsonl"
    path.write_text(path.read_text() + '{"name": "track", "key"\nnot JSON\n{"name": "other"}\n')
    assert set(read_completed(parts.folder)) == {"header"}


def copy(parts: Parts, folder: Path) -> None:
    shutil.copytree(parts.folder, folder, dirs_exist_ok=True)


def test_killed_at_any_step_of_a_note_the_notes_are_those_before_or_one_more(tmp_path: Path, parts: Parts) -> None:
    """And the next note is not lost, as it was when it was appended to a line that a kill had cut."""

    def noted(folder: Path) -> None:
        Parts(folder).record(TaskResult("track", 0, 1.0), "key", folder / "header.sgs", frames=5)

    for folder in folders_of_the_killed(tmp_path, noted, begin=lambda folder: copy(parts, folder)):
        assert set(read_completed(folder)) in ({"header"}, {"header", "track"})
        noted(folder)
        assert set(read_completed(folder)) == {"header", "track"}


def test_killed_at_any_step_of_clearing_what_is_left_is_refused_as_before_or_nothing(
    tmp_path: Path, parts: Parts
) -> None:
    parts.use_plan({"capture": "old"})

    def cleared(folder: Path) -> None:
        with Parts(folder).locked():
            Parts(folder).clear()

    for folder in folders_of_the_killed(tmp_path, cleared, begin=lambda folder: copy(parts, folder)):
        left = Parts(folder)
        if left.header.exists():
            with pytest.raises(ConfigError, match="has parts of another run"):
                left.use_plan({"capture": "new"})
        assert not left.completed or left.header.exists()


def test_cleared_is_empty(parts: Parts) -> None:
    with parts.locked():
        parts.clear()
        assert sorted(path.name for path in parts.folder.rglob("*")) == [".driver", "segments", MARKER]
    assert not parts.completed


def test_what_others_have_put_beside_the_parts_stays(parts: Parts) -> None:
    others = ["mine.txt", "header.txt", "segments/mine.sgs", "logs/diary.txt", "deep/down/plan.json"]
    for name in others:
        (parts.folder / name).parent.mkdir(parents=True, exist_ok=True)
        (parts.folder / name).write_text("mine")
    (parts.folder / "header.log.jsonl").symlink_to(parts.folder / "mine.txt")
    with parts.locked():
        parts.clear()
    assert all((parts.folder / name).read_text() == "mine" for name in others)
    assert not parts.header.exists()
    assert not (parts.folder / "header.log.jsonl").exists()


def test_a_folder_that_is_not_of_parts_is_refused(tmp_path: Path) -> None:
    folder = tmp_path / "out.sgs.parts"
    (folder / "segments").mkdir(parents=True)
    (folder / "plan.json").write_text("{}")
    with pytest.raises(StorageError, match="somebody else's; nothing in it was changed"), Parts(folder).locked():
        pass
    with pytest.raises(StorageError, match="somebody else's"):
        Parts(folder).clear()
    assert (folder / "plan.json").read_text() == "{}"
    assert not (folder / MARKER).exists()


def test_a_run_that_begins_anew_has_another_name(parts: Parts) -> None:
    parts.use_plan({"capture": "a"})
    first = parts.run
    parts.use_plan({"capture": "a"})
    assert parts.run == first != ""
    (parts.folder / "plan.json").write_text("[" * 9999)
    assert parts.run == ""
    with parts.locked():
        parts.clear()
    parts.use_plan({"capture": "a"})
    assert parts.run not in ("", first)


def test_a_folder_that_cannot_be_made_is_reported(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with (
        pytest.raises(StorageError, match="cannot be used for the parts of a parallel run"),
        Parts(tmp_path / "file" / "parts").locked(),
    ):
        pass
