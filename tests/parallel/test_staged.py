# SPDX-License-Identifier: Apache-2.0
"""Files of a command come from a store and go to it, also while they grow, and after the command was killed."""

import json
import os
import shutil
import signal
import subprocess
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest

from structgstream.parallel import exchange as staged
from structgstream.parallel.driver import Unit
from structgstream.parallel.exchange import ObjectFolder, ObjectStore, Staging, Transfer
from structgstream.parallel.parts import Parts
from tests.support.sleepers import is_gone, wait_for


@pytest.fixture(autouse=True)
def quick(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(staged, "FIRST_DELAY_SECONDS", 0.0)
    monkeypatch.setattr(staged, "POLL_SECONDS", 0.01)
    monkeypatch.setenv(staged.SCRATCH, str(tmp_path / "scratch"))


@pytest.fixture
def store(tmp_path: Path) -> ObjectFolder:
    return ObjectFolder(f"file://{tmp_path / 'store'}")


@pytest.fixture
def staging(store: ObjectFolder, tmp_path: Path) -> Staging:
    return Staging(store, tmp_path / "here")


def run(store: ObjectFolder, script: str, **files: Any) -> int:
    """The status of a command with these files, whose first word is the folder of this machine."""
    with pytest.MonkeyPatch.context() as variables:
        variables.setenv(staged.STORE, store.url)
        return staged.run(Transfer("task", **files), ["sh", "-c", script, staged.HERE])


def scratch(tmp_path: Path) -> list[Path]:
    return [*(tmp_path / "scratch").iterdir()] if (tmp_path / "scratch").exists() else []


def test_needs_are_fetched_and_results_stored(store: ObjectFolder, tmp_path: Path) -> None:
    store.write("in/a", b"content")
    script = 'mkdir -p "$0/out" && tr a-z A-Z < "$0/in/a" > "$0/out/b" && [ ! -e "$0/absent" ]'
    assert run(store, script, needs=("in/a", "absent"), gives=("out/b",)) == 0
    assert store.read("out/b") == b"CONTENT"
    assert not scratch(tmp_path)


def test_what_a_killed_command_has_left_is_not_taken_and_stays_here(store: ObjectFolder, tmp_path: Path) -> None:
    store.write("a", b"a")
    files = {"needs": ("a",), "gives": ("b",)}
    assert run(store, 'echo half > "$0/b"; exit 137', **files) == 137
    assert store.read("b") is None
    # The next attempt finds it.
    assert run(store, 'grep -q half "$0/b"', **files) == 0
    assert store.read("b") == b"half\n"
    assert not scratch(tmp_path)


def test_what_a_failing_command_has_left_is_removed(store: ObjectFolder, tmp_path: Path) -> None:
    assert run(store, 'echo half > "$0/b"; exit 3', gives=("b",)) == 3
    assert not scratch(tmp_path)


def test_a_command_ends_with_the_process_that_stages_it(store: ObjectFolder, tmp_path: Path) -> None:
    script = f"echo $$ > {tmp_path}/pid.new; mv {tmp_path}/pid.new {tmp_path}/pid; exec sleep 60"
    words = [sys.executable, "-m", staged.__name__, json.dumps(asdict(Transfer("task"))), "sh", "-c", script]
    process = subprocess.Popen(words, env={**os.environ, staged.STORE: store.url})
    wait_for(tmp_path / "pid")
    process.kill()
    process.wait()
    assert is_gone(int((tmp_path / "pid").read_text()))


def test_a_run_that_was_begun_anew_finds_nothing_of_the_one_before(store: ObjectFolder, tmp_path: Path) -> None:
    files = {"needs": ("header",), "gives": ("b",)}
    store.write("header", b"old")
    assert run(store, 'echo half > "$0/b"; exit 137', run="1", **files) == 137
    store.write("header", b"new")
    assert run(store, 'grep -q new "$0/header"; [ -e "$0/b" ]; exit 137', run="1", **files) == 137
    (other,) = scratch(tmp_path)
    mine = other.with_name(other.name.replace("-1", "-mine"))
    mine.mkdir()
    assert run(store, 'grep -q new "$0/header" && [ ! -e "$0/b" ]', run="2", **files) == 0
    assert scratch(tmp_path) == [mine], "a folder without a marker stays"


def test_a_result_of_before_is_brought_to_be_checked(store: ObjectFolder) -> None:
    store.write("b", b"before\n")
    assert run(store, 'grep -q before "$0/b"', gives=("b",)) == 0


def test_growing_files_are_stored_before_the_command_ends(store: ObjectFolder, tmp_path: Path) -> None:
    """It waits for what the store has of its files, so that it would not end otherwise."""
    stored = tmp_path / "store"
    script = f"""
echo groups > "$0/t.groups"; printf abc > "$0/t.partial"
until [ -e "{stored}/t.groups" ] && [ "$(cat "{stored}/t.partial")" = abc ]; do sleep 0.01; done
printf de >> "$0/t.partial"
until [ "$(cat "{stored}/t.partial")" = abcde ]; do sleep 0.01; done
printf f >> "$0/t.partial"; mv "$0/t.partial" "$0/t"
"""
    store.write("unused", b"")
    assert run(store, script, grows=("t.groups", "t.partial"), gives=("t",)) == 0
    assert store.read("t") == b"abcdef"


def test_a_growing_file_goes_on_here_or_on_another_machine(store: ObjectFolder, tmp_path: Path) -> None:
    files = {"grows": ("t.partial",), "gives": ("t",)}
    store.write("t.partial", b"abc")
    assert run(store, 'printf d >> "$0/t.partial"; exit 137', **files) == 137
    store.write("t.partial", b"of another attempt")
    assert run(store, 'printf e >> "$0/t.partial"; exit 137', **files) == 137
    assert store.read("t.partial") == b"abcde"
    shutil.rmtree(tmp_path / "scratch")
    store.write("t", b"whole")
    assert run(store, '[ ! -e "$0/t.partial" ]', **files) == 0, "a whole file is not one that grows"


def test_a_growing_file_is_stored_when_it_is_a_tenth_longer(staging: Staging) -> None:
    path = staging.folder / "t"
    path.parent.mkdir()
    for content, ended, stored in (
        (b"a" * 100, False, 100),
        (b"a" * 105, False, 100),
        (b"a" * 120, False, 120),
        (b"a" * 90, False, 90),
        (b"a" * 91, True, 91),
    ):
        path.write_bytes(content)
        staging.put_growing("t", ended=ended)
        assert staging.store.size("t") == stored


def test_a_command_that_is_killed_ends_this_process_the_same_way(store: ObjectFolder, tmp_path: Path) -> None:
    words = [json.dumps(asdict(Transfer("task", grows=("t.partial",)))), "sh", "-c"]
    script = 'printf abc > "$0/t.partial"; kill -9 $$'
    done = subprocess.run(
        [sys.executable, "-m", "structgstream.parallel.exchange", *words, script, staged.HERE],
        env={**os.environ, staged.STORE: store.url, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
        check=False,
    )
    assert done.returncode == -signal.SIGKILL
    assert store.read("t.partial") == b"abc", "what had grown is in the store"
    assert len(scratch(tmp_path)) == 1, "and here, for the next attempt"


def test_a_store_that_cannot_be_used_is_a_sentence(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv(staged.STORE, "nonsense://a")
    monkeypatch.setattr(sys, "argv", ["staged", json.dumps({"name": "task"}), "true"])
    assert staged.main() == 1
    error = capsys.readouterr().err
    assert error.startswith("structgstream: nonsense://a cannot be used as a store (")
    assert error.count("\n") == 1


def test_the_url_of_the_store_is_on_no_command_line(tmp_path: Path) -> None:
    """It may hold credentials, and every user of a machine sees command lines."""
    url = f"file://{tmp_path / 'secret'}"
    parts = Parts(tmp_path / "a.parts")
    task = ObjectStore(ObjectFolder(url), parts).header(Unit("capture").header_task(parts))
    assert not any("secret" in word for word in task.command)
    assert task.environment[staged.STORE] == url
