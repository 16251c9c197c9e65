# SPDX-License-Identifier: Apache-2.0
"""A sweep goes on where it was stopped, does nothing twice, and one failure takes along only what needs it."""

import os
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from fake_tasks import Frames
from structgstream.errors import ConfigError
from structgstream.evaluation.run_log import log_path, read_log
from structgstream.executors.tasks import ExecutorOptions
from structgstream_studies.experiments import sweep as module
from structgstream_studies.experiments.sweep import Listener, Outcome, Progress, executor_for, sweep, unique

TESTS = Path(__file__).parent


def swept(tasks: list[Frames], folder: Path, *, listener: Listener | None = None) -> Outcome:
    """A sweep in two processes, which find the tasks' module."""
    with pytest.MonkeyPatch.context() as patched, executor_for("reference", ExecutorOptions(workers=2)) as executor:
        patched.setenv("PYTHONPATH", os.pathsep.join([str(TESTS), *filter(None, sys.path)]))
        return sweep(tasks, executor, folder=folder, device="reference", listener=listener)


def tasks_in(folder: Path) -> list[Frames]:
    """Two that must run at the same time, one that fails before its second frame, and those that need them."""
    return [
        Frames("ready", folder),
        Frames("left", folder, meets="right"),
        Frames("right", folder, meets="left"),
        Frames("bad", folder, frames=5, fails_at=1, waits_at=3),
        Frames("after bad", folder, needs=("bad",)),
        Frames("after after bad", folder, needs=("after bad",)),
        Frames("after left", folder, needs=("left", "ready")),
    ]


def contents(folder: Path) -> dict[str, tuple[bytes, int]]:
    """What the tasks have written, and when."""
    return {path.name: (path.read_bytes(), path.stat().st_mtime_ns) for path in folder.glob("*.jsonl")}


class Stopped:
    """A sweep that fails, is begun again and stopped, and then goes on to its end."""

    def __init__(self, folder: Path) -> None:
        tasks = tasks_in(folder)
        log_path(tasks[0].stream).write_text('{"index": 0}\n')
        self.folder = folder
        self.shown: list[Progress] = []
        self.first = swept(tasks, folder, listener=self.shown.append)
        self.after_first = contents(folder)

        def stop(progress: Progress) -> None:
            if progress.running.get("bad", (0, 5)) == (3, 5):
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            swept(tasks, folder, listener=stop)
        self.after_second = contents(folder)
        self.process_of_second = read_log(tasks[3].stream)[2]["process"]
        (folder / "go").touch()
        self.third = swept(tasks[:-2], folder)
        self.after_third = contents(folder)


@pytest.fixture(scope="module")
def stopped(tmp_path_factory: pytest.TempPathFactory) -> Stopped:
    return Stopped(tmp_path_factory.mktemp("sweep"))


def test_a_failure_is_reported_by_name_and_takes_along_what_needs_it(stopped: Stopped) -> None:
    assert stopped.first == Outcome(failed=("bad",), blocked=("after bad", "after after bad"), skipped=("ready",))
    assert set(stopped.after_first) == {f"{name}.log.jsonl" for name in ("ready", "left", "right", "bad", "after left")}
    assert "bad: there was no power." in (stopped.folder / "logs" / "bad.txt").read_text()
    assert "left says that it is done" in (stopped.folder / "logs" / "left.txt").read_text()


def test_two_seats_run_two_tasks_at_a_time_each_in_a_process(stopped: Stopped) -> None:
    """Left and right wait for each other, so that neither would end alone."""
    entries = [read_log(stopped.folder / f"{name}.sgs")[0] for name in ("left", "right", "after left")]
    assert len({os.getpid(), *(entry["process"] for entry in entries)}) == 4
    assert {entry["backend"] for entry in entries} == {"reference"}
    assert max(len(progress.running) for progress in stopped.shown) == 2


def test_progress_counts_what_was_done_before(stopped: Stopped) -> None:
    assert stopped.shown[0].finished == 1
    assert {progress.total for progress in stopped.shown} == {7}
    last = stopped.shown[-1]
    assert (last.running, last.finished, last.failed) == ({}, 4, ("bad",))


def test_after_ctrl_c_processes_are_gone_and_frames_stay(stopped: Stopped) -> None:
    with pytest.raises(ProcessLookupError):
        os.kill(stopped.process_of_second, 0)
    assert stopped.after_second["bad.log.jsonl"][0].count(b"\n") == 3


def test_nothing_is_done_twice(stopped: Stopped) -> None:
    for earlier, later in ((stopped.after_first, stopped.after_second), (stopped.after_second, stopped.after_third)):
        for name in earlier.keys() - {"bad.log.jsonl"}:
            assert later[name] == earlier[name], name
        assert later["bad.log.jsonl"][0].startswith(earlier["bad.log.jsonl"][0])


def test_what_is_left_is_done_in_the_end(stopped: Stopped) -> None:
    assert stopped.third == Outcome(failed=(), blocked=(), skipped=("left", "ready", "right"))
    entries = read_log(stopped.folder / "bad.sgs")
    assert list(entries) == [0, 1, 2, 3, 4]
    assert len({entries[index]["process"] for index in (0, 1, 3)}) == 3
    assert read_log(stopped.folder / "after bad.sgs")


def test_a_sweep_of_nothing_ends_at_once(stopped: Stopped) -> None:
    done = tasks_in(stopped.folder)[:4]
    assert swept(done, stopped.folder / "none").skipped == ("bad", "left", "ready", "right")
    assert not (stopped.folder / "none").exists()
    assert swept([], stopped.folder / "none") == Outcome((), (), ())


def test_a_gpu_is_asked_for_where_there_is_one(monkeypatch: pytest.MonkeyPatch) -> None:
    import torch

    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    assert [module.gpus_of(device) for device in ("auto", "cuda", "cpu")] == [2, 2, 0]
    executor_for("cuda", ExecutorOptions()).engine.check(1)
    with pytest.raises(ConfigError, match="needs 1 GPUs, and a worker here has 0"):
        executor_for("cpu", ExecutorOptions()).engine.check(1)


def test_no_jobs_are_refused() -> None:
    with pytest.raises(ConfigError, match="1 or more, got 0"):
        executor_for("cpu", ExecutorOptions(workers=0))


def test_tasks_of_one_name_are_one(tmp_path: Path) -> None:
    first, second, third = tasks_in(tmp_path)[:3]
    assert unique([first, second, replace(first, frames=1), third, second]) == [first, second, third]
